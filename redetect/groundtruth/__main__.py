"""``python -m redetect.groundtruth`` is the command ``groundtruth``."""

import sys

from redetect.groundtruth.cli import main

sys.exit(main())
