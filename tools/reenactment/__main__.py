"""``python -m tools.reenactment``."""

import sys

from tools.reenactment.cli import main

sys.exit(main())
