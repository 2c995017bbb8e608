"""Tables that depend on the calibration only, and their cache."""

from lut.cache import cache_folder as cache_folder
from lut.cache import cached_disc_table as cached_disc_table
from lut.cache import cached_vertical_table as cached_vertical_table
from lut.cache import cached_vote_table as cached_vote_table
from lut.outlines import DiscShape as DiscShape
from lut.outlines import DiscTable as DiscTable
from lut.outlines import TableError as TableError
from lut.outlines import build_disc_table as build_disc_table
from lut.verticals import VerticalTable as VerticalTable
from lut.verticals import build_vertical_table as build_vertical_table
from lut.votes import VoteShape as VoteShape
from lut.votes import VoteTable as VoteTable
from lut.votes import build_vote_table as build_vote_table
