"""Imported last by the process that workers are forked from: what it holds stays shared with them.

Python's garbage collector writes into every object that it looks at, so the first full collection in a worker
would copy all pages of the modules it was born with, about 90 MiB. What is frozen is not looked at.
"""

import gc

gc.freeze()
