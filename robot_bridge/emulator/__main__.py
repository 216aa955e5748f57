"""`python -m robot_bridge.emulator`."""

import sys

from robot_bridge.emulator.server import main

sys.exit(main())
