"""Run the console as `python -m maplab_py`."""

import sys

from maplab_py.console.main import main

sys.exit(main())
