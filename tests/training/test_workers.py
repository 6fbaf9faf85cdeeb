"""The process that workers are forked from."""

import subprocess
import sys


def test_a_collection_in_a_worker_leaves_the_modules_it_was_born_with_alone() -> None:
    """Else the first full collection in each worker would copy the memory that all of them share."""
    code = (
        "import gc, multiprocessing\n"
        "from foredrive.training.interrupts import start_fork_server\n"
        "start_fork_server(preload='decimal')\n"
        "with multiprocessing.get_context('forkserver').Pool(1) as pool:\n"
        "    print(pool.apply(gc.get_freeze_count))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 5_000  # objects of the modules that any Python process imports
