"""Train a robot to find its way: `python train.py`; `--help` and `--help-all` show the flags."""

import signal
import sys

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while libraries load: nothing to save yet

from sofnn_torch.cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
