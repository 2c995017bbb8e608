"""Writes results to disk: completely or not at all, and never over a user's files.

All packages write their files with `write_whole`, or `write_bytes` if the content is in memory.
"""

from redetect.storage.parts import OutputExistsError as OutputExistsError
from redetect.storage.parts import demand_distinct as demand_distinct
from redetect.storage.parts import demand_free as demand_free
from redetect.storage.parts import demand_place as demand_place
from redetect.storage.parts import demand_writable as demand_writable
from redetect.storage.parts import write_bytes as write_bytes
from redetect.storage.parts import write_text as write_text
from redetect.storage.parts import write_whole as write_whole

#: Suffixes of the image files that are read (`redetect.storage.images`).
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".bmp", ".tif", ".tiff")
