"""python -m holod_training {train,compare,evaluate,eyebox,export,golden,bench-engines}"""

from __future__ import annotations

import sys

from holod_training.cli import main

sys.exit(main())
