"""`python -m robot_bridge.emulator`."""

import sys

from robot_bridge.emulator.main import main

sys.exit(main())
