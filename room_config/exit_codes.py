"""How the commands end: the codes that scripts rely on."""

DONE = 0
BAD_INPUT = 2  # bad input or configuration; one clear line on standard error
COULD_NOT = 3  # no fiducial, not converged, not started
INTERRUPTED = 130
