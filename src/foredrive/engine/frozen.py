"""Settings of the fork server, from which worker processes are forked. It imports this module last.

Python's garbage collector writes into every object that it visits. The first full collection in a worker
would therefore copy all pages of the modules it inherited, about 90 MiB. Frozen objects are not visited, so
their pages stay shared.
"""

import atexit
import gc
import os
import shutil

SOCKETS = "FOREDRIVE_SOCKETS"
"""Environment variable with the folder of the program's sockets. It is set in the fork server only."""

if (folder := os.environ.pop(SOCKETS, None)) is not None:
    # A killed program cannot remove its folder. This process ends after the program and its workers.
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    gc.freeze()
