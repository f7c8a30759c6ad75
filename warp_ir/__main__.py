"""``python -m warp_ir`` is the command `warp-ir`."""

import sys

from warp_ir.cli import main

sys.exit(main())
