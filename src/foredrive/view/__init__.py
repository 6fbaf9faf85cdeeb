"""Pictures and reports."""

import logging

# Matplotlib uses a temporary folder where the home folder cannot be written to, and would say so at length.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
