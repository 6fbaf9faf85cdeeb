"""Entry point of `python -m foredrive`."""

import sys

from foredrive.cli.main import main

sys.exit(main())
