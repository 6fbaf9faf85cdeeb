"""Garbage collector setting for worker processes; import it last in the process they are forked from.

Python's garbage collector writes into every object that it visits. The first full collection in a worker
would therefore copy all pages of the modules it inherited, about 90 MiB. Frozen objects are not visited, so
their pages stay shared.
"""

import gc

gc.freeze()
