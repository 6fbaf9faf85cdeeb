"""py123d's PandaSet parser, with a safe reader of its pickle files.

Raw PandaSet stores sweeps, cuboids and semantic labels as gzipped pickles of tables. py123d opens all of them
with one unrestricted unpickling function. Converting a log, or opening one that refers to raw sweeps, could
thus run any code in the files. This module replaces that function for all of py123d.
"""

from py123d.parser.pandaset import pandaset_parser, pandaset_sensor_io
from py123d.parser.pandaset.pandaset_parser import PandasetLogParser

from foredrive.data.safe_pickle import load_table

pandaset_parser.read_pkl_gz = load_table
pandaset_sensor_io.read_pkl_gz = load_table

__all__ = ["PandasetLogParser"]
