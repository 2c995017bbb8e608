"""``python -m slam`` is the command ``slam``."""

import sys

from slam.cli import main

sys.exit(main())
