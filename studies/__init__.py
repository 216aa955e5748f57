"""The paper's tables and figures, and ours beside them."""

import logging

# that it builds its list of fonts, or misses one, is nothing to tell whoever asked for a figure
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)
