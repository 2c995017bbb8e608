"""Writes results to disk: completely or not at all, and never over a user's files.

All packages write their files with `write_whole`.
"""

from redetect.storage.parts import OutputExistsError as OutputExistsError
from redetect.storage.parts import write_whole as write_whole
