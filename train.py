"""Train a robot to find its way: `python train.py`; `python train.py --help` shows all flags."""

import signal
import sys

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while libraries load: nothing to save yet

from sofnn_torch.cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
