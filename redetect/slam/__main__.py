"""``python -m redetect.slam`` is the command ``slam``."""

import sys

from redetect.slam.cli import main

sys.exit(main())
