"""`python -m studies ...`, the same as `autospine study ...`."""

from studies.command_line import app

app(prog_name="autospine study")
