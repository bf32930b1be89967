"""`python -m npa_envs`, the same as the command `npa-envs`."""

import sys

from npa_envs.cli import main

sys.exit(main())
