"""From one image to landmarks, their comparison with a reference, the command line."""

from redetect.storage import __version__ as __version__
