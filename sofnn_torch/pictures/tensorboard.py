"""TensorBoard: scalars, settings, pictures and now and then a video of a training run.

Names and formulas of the metrics are in docs/metrics.md; the horizontal axis is the trial.
Nothing here touches the learner's random numbers or the training environment, and nothing here
stops a training: what cannot be written or drawn is said once and left out.
"""

import dataclasses
import functools
import gc
import io
from collections import deque
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard.summary import hparams, text

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.pictures import figures
from sofnn_torch.pictures.events import EventFile
from sofnn_torch.pictures.film import film, gif
from sofnn_torch.runs.directory import flatten
from sofnn_torch.runs.factory import make_plan
from sofnn_torch.runs.preset_files import differences
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.runs.trial import Trajectory, TrialRecord
from sofnn_torch.terminal import say

WINDOW = 10  # trials in the moving success rate
VIDEO_STEPS = 1000  # a robot that does not find the goal is not filmed for ever
FIRST = "1_result"  # groups stand in the order of their names: what one wants to see first
HPARAM_METRICS = (f"{FIRST}/steps", f"{FIRST}/success_last_10", f"{FIRST}/return", "rules/count")
ALWAYS = ("env", "agent", "network", "pose", "preset", "seed")  # settings that tell runs apart
DPI = 160  # of pictures of 5 inches
TAGS = {
    "pose_error": "pose/error_mean",
    "pose_error_max": "pose/error_max",
    "heading_error": "pose/heading_error_mean",
}


def scalars(
    record: TrialRecord,
    successes: Collection[float],
    steps_per_second: float,
    learner: str,
) -> list[Summary.Value]:
    """The curves' values after a trial.

    Args:
        record: the trial.
        successes: whether each of the last trials was one; of a task that says so.
        steps_per_second: simulator steps over wall-clock time of the trial.
        learner: its name, in that of its errors: those of two learners have scales of their own.
    """
    values: dict[str, float] = {
        f"{FIRST}/steps": record.steps,
        f"{FIRST}/return": record.reward,
        "trial/decisions": record.decisions,
        "trial/total_steps": record.total_steps,
        "rules/count": record.rules,
        "speed/steps_per_second": steps_per_second,
    }
    if record.success is not None:
        values["trial/success"] = float(record.success)
        values[f"{FIRST}/success_last_10"] = sum(successes) / len(successes)
    values |= {TAGS.get(k, f"trial/{k}"): v for k, v in record.measures.items()}
    own = {"learning/error_rms": f"learning/error_rms_{learner}"}
    values |= {own.get(k, k): v for k, v in record.statistics.items()}
    return [Summary.Value(tag=k, simple_value=v) for k, v in values.items()]


class Monitor:
    """Writes a run's progress for TensorBoard into its directory.

    Args:
        run_dir: directory of the run.
        config: settings of the run: all of them under TEXT, those that change a preset or tell runs
            apart under HPARAMS.
        first_trial: the trial that comes next; what an interrupted run wrote from there on is
            hidden, and successes before it are read from ``trials.csv``.
        picture_every: trials between two sets of pictures, 0 for none.
        video_every: trials between two videos, 0 for none.
    """

    def __init__(
        self,
        run_dir: Path,
        config: Config,
        first_trial: int = 1,
        picture_every: int = 25,
        video_every: int = 50,
    ):
        self.run_dir, self.config = Path(run_dir), config
        self.picture_every, self.video_every = picture_every, video_every
        self.successes: deque[float] = deque(self._earlier_successes(first_trial), maxlen=WINDOW)
        self._broken: set[str] = set()
        self._warned = False
        self._events: EventFile | None = None
        self._guard("TensorBoard", lambda: self._open(first_trial))

    def trial(
        self, record: TrialRecord, path: Trajectory, agent: Learner, steps_per_second: float
    ) -> None:
        """Write the scalars of a trial and, when their turn has come, pictures and a video.

        Args:
            record: the trial.
            path: where the robot went in it.
            agent: the learner after the trial.
            steps_per_second: simulator steps over wall-clock time of the trial.
        """
        if record.success is not None:
            self.successes.append(record.success)
        self._guard("TensorBoard", lambda: self._scalars(record, steps_per_second))
        if self.config.env == MAZE and self._due(record.trial, self.picture_every):
            self._guard("pictures", lambda: self._pictures(record.trial, path, agent))
        if self._due(record.trial, self.video_every):
            self._guard("video", lambda: self._video(record.trial, agent))

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        if self._events is not None:
            self._guard("TensorBoard", self._events.flush)

    def close(self) -> None:
        """Write what is still in memory and give the file back."""
        if self._events is not None:
            self._guard("TensorBoard", self._events.close)
            self._events = None

    def _guard(self, part: str, action: Callable[[], object]) -> None:
        """Run an action; say a failure once and go on without, or try again if it is the disk."""
        if part in self._broken:
            return
        try:
            action()
        except OSError as error:
            self._events = None
            if not self._warned:
                self._warned = True
                say(
                    f"warning: no TensorBoard in {self.run_dir} for now, training goes on "
                    f"({error.strerror or error})"
                )
        except Exception as error:  # GL and drawing fail in many ways; none may end a run
            self._broken.add(part)
            reason = " ".join(str(error).split()) or type(error).__name__
            say(f"warning: no {part} from now on, training goes on ({reason})")

    def _open(self, trial: int) -> EventFile:
        self._events = events = EventFile(self.run_dir, trial)
        self._settings(events)
        return events

    def _settings(self, events: EventFile) -> None:
        """Write the settings into this run; torch's `add_hparams` would make a second."""
        everything = flatten(dataclasses.asdict(self.config))
        lines = "".join(f"    {name} = {value}\n" for name, value in everything.items())
        events.add(text("settings", lines))
        shown = dict.fromkeys([*ALWAYS, *differences(self.config)])
        settings = {name: everything[name] for name in shown if name in everything}
        plain = {
            name: value if isinstance(value, bool | int | float | str) else str(value)
            for name, value in settings.items()
        }
        for summary in hparams(plain, dict.fromkeys(HPARAM_METRICS)):
            events.add(summary)

    def _scalars(self, record: TrialRecord, steps_per_second: float) -> None:
        events = self._events
        if events is None or not events.path.exists():  # the disk failed, or deleted
            events = self._open(record.trial)
        name = self.config.learner.name
        values = scalars(record, self.successes, steps_per_second, name)
        events.add(Summary(value=values), record.trial)
        events.flush()

    @functools.cached_property
    def _plan(self) -> MazePlan:
        return make_plan(self.config)

    def _pictures(self, trial: int, path: Trajectory, agent: Learner) -> None:
        plan, states = self._plan, path.decided_at(self.config.pose)
        drawings: dict[str, Callable[[Axes], object]] = {
            "trajectory": lambda ax: figures.trajectory(plan, path, ax),
            "rules": lambda ax: figures.rule_map(plan, agent, ax, agent.usage(states)),
            "policy": lambda ax: figures.action_field(plan, agent, ax),
            "pose_error": lambda ax: figures.pose_error(path, ax, plan),
        }
        if agent.plan(states[:1]).value is not None:
            drawings["value"] = lambda ax: figures.value_field(plan, agent, ax)
        for name, draw in drawings.items():
            figure, (ax,) = figures.canvas(width=5, height=5, tight=False)
            draw(ax)
            self._image(f"pictures/{name}", figures.png(figure, dpi=DPI), trial)
        gc.collect()  # figures refer to themselves: 200 MiB would wait for the next full collection

    def _video(self, trial: int, agent: Learner) -> None:
        # Other tasks draw as they like, one picture for each step.
        shape = {"steps_per_frame": 10, "size": 240} if self.config.env == MAZE else {}
        frames = film(self.config, agent, limit=VIDEO_STEPS, **shape)
        self._image("video/evaluation", gif(frames), trial)

    def _image(self, name: str, data: bytes, trial: int) -> None:
        width, height = Image.open(io.BytesIO(data)).size
        image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=data)
        summary = Summary(value=[Summary.Value(tag=name, image=image)])
        if self._events is not None:
            self._events.add(summary, trial)

    @staticmethod
    def _due(trial: int, every: int) -> bool:
        return every > 0 and trial % every == 0

    def _earlier_successes(self, first_trial: int) -> NDArray[np.float64]:
        with suppress(OSError, ValueError):
            if first_trial > 1:
                column = figures.read_column(self.run_dir / "trials.csv", "success")
                return column[max(0, first_trial - 1 - WINDOW) : first_trial - 1]
        return np.array([])
