"""Layer 10: ``python -m rbd_jax``."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
