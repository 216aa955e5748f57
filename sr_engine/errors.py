"""What the engine refuses, and why: one type a reason, each with a short stable code."""

from typing import ClassVar


class EngineError(ValueError):
    """The engine cannot give an honest answer. The message is one line; `reason` is its code."""

    reason: ClassVar[str] = "engine"


class ShapeError(EngineError):
    """Frames, shifts or parameters of sizes that do not fit together, or no pixels at all."""

    reason = "shape"


class ParameterError(EngineError):
    """A parameter outside of its range."""

    reason = "parameter"


class NonSquarePixelsError(EngineError):
    """Pixels of unequal sides: a round object is an ellipse in them, which is not modelled."""

    reason = "non-square-pixels"


class NotFiniteError(EngineError):
    """NaN or infinity among pixels, shifts or start values."""

    reason = "not-finite"


class NoRoundObjectError(EngineError):
    """Nothing round, of the allowed size, stands out from the noise."""

    reason = "no-round-object"


class ConstantFrameError(NoRoundObjectError):
    """All pixels have one value."""

    reason = "constant"


class ObjectAtBorderError(EngineError):
    """The object is cut by the border of the frame."""

    reason = "at-border"


class AmbiguousObjectError(EngineError):
    """Two or more candidates are equally good and no start was given to choose by."""

    reason = "ambiguous"


class SaturatedError(EngineError):
    """Pixels of the object stand at the top of the number range: its edge is not where it seems."""

    reason = "saturated"


class SingularShiftSetError(EngineError):
    """The shift set does not determine the finer grid."""

    reason = "singular-shifts"


class InconsistentFramesError(EngineError):
    """Frames disagree with their shifts: one was taken at another shift, or the object moved."""

    reason = "inconsistent-frames"


class NotConvergedError(EngineError):
    """The fit did not settle on an answer inside of its bounds."""

    reason = "not-converged"


class OutsideGateError(EngineError):
    """The object found is not where, or not as large as, it was predicted to be."""

    reason = "outside-gate"


class TemplateError(EngineError):
    """The frames do not make a template: too few, wrongly displaced, or not of one object."""

    reason = "template"


class TemplateMismatchError(EngineError):
    """A frame that does not show what the template shows: another object, or a changed one."""

    reason = "template-mismatch"
