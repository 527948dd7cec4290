"""`python -m palpate` is `palpate`."""

import sys

from palpate.cli import main

sys.exit(main())
