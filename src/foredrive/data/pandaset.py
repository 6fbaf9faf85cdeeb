"""PandaSet as py123d reads it, but without running what its pickles say.

Raw PandaSet keeps sweeps, cuboids and semantic labels as gzipped pickles of tables. py123d opens all of them
with one function, which unpickles freely: to convert a log, or to open one that refers to raw sweeps, would
run whatever the files ask for. That function is replaced here, for all of py123d.
"""

from py123d.parser.pandaset import pandaset_parser, pandaset_sensor_io
from py123d.parser.pandaset.pandaset_parser import PandasetLogParser

from foredrive.data.safe_pickle import load_table

pandaset_parser.read_pkl_gz = load_table
pandaset_sensor_io.read_pkl_gz = load_table

__all__ = ["PandasetLogParser"]
