"""The fiducial's own image as the template, for a fiducial of any shape."""

from sr_engine.template.fit import TemplateFit
from sr_engine.template.learn import Template, learn_template

__all__ = ["Template", "TemplateFit", "learn_template"]
