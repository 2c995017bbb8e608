"""``python -m camera`` is the command ``camera``."""

import sys

from camera.cli import main

sys.exit(main())
