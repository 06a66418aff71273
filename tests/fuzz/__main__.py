"""`python -m tests.fuzz`."""

import sys

from .campaign import main

sys.exit(main())
