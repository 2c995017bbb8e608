"""``python -m groundtruth`` is the command ``groundtruth``."""

import sys

from groundtruth.cli import main

sys.exit(main())
