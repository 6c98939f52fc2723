"""A few rules fitted to what a learned policy does at many states.

The states are clustered, with the action as one more coordinate, and each cluster becomes a rule.
Then centres, widths and consequents of all rules are moved together, by Adam, so that the small
policy decides at every state as the full one: for actions to choose among by cross entropy, for
vectors by squared error. Two more terms keep rules readable: each concludes by itself, and all
conclude together, at the centre of a rule what the full policy does there. No consequent leaves the
range that it has in the full rule base.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor
from torch.nn import functional

from sofnn_torch.learners.learner import CHUNK, Learner

RATES = 0.03, 0.02, 0.05  # of centres and log widths, in widths of a new rule, and consequents
BATCH = 512  # states a step
NARROWEST, WIDEST = 0.3, 20.0  # widths, over that of a new rule
APART = 2.0  # distance of states of different actions when they are clustered, in widths
SHARP = 0.3  # temperature of the cross entropy, over the usual lead of an action
WHOLE = 0.3  # weight of the error of all outputs beside that of decisions
READABLE = 0.05  # weight of what rules say at their centres
EVERY = 20  # steps after which the full policy is asked anew what it does at the centres


class Fit:
    """Some rules that come to decide as a learner does.

    Letters in shapes: ``n`` inputs of the rules, ``m`` consequents, ``k`` rules, ``B`` states,
    ``J`` actions to choose among.

    Args:
        agent: the learner with the full rule base; it stays as it is.
        states: that its policy visits. Shape: (B, d).
        count: rules, fewer than the states.
        seed: of the clustering and the choice of batches.

    Raises:
        ValueError: the learner does not say how its outputs become actions.

    Example:
        >>> from sofnn_torch import QLearning
        >>> agent = QLearning.for_env("CartPole-v1", seed=0)
        >>> fit = Fit(agent.learner, states, 20, seed=0)  # doctest: +SKIP
        >>> fit.improve(states, steps=300)  # doctest: +SKIP
    """

    def __init__(self, agent: Learner, states: NDArray[np.float32], count: int, seed: int):
        self.agent, self.net = agent, agent.net
        try:
            self.decoding = agent.decoding()
        except ValueError:
            raise ValueError(
                f"--reduce: --agent {agent.name} does not say how outputs become actions (decoding)"
            ) from None
        self.chooses = bool(agent.choices)
        self.by_action = len(agent.inputs) > len(agent.task.axes)
        self.chance = torch.Generator().manual_seed(seed)
        self.unit = self.net.default_width[:, None]  # (n, 1)
        consequents = self.net.consequents
        low, high = consequents.amin(0), consequents.amax(0)
        self.learned = high > low  # the others are the same in all rules, and stay
        self.span = torch.where(self.learned, high - low, torch.ones_like(low))[:, None]  # (m, 1)
        self.low, self.high = low[:, None] / self.span, high[:, None] / self.span
        self._begin(states, count, seed)

    # ------------------------------------------------------------------------------ the policy

    def rules(self) -> tuple[Tensor, Tensor, Tensor]:
        """Centres (n, k), widths (n, k) and consequents (m, k), differentiable."""
        centres, widths = self.centres * self.unit, self.log_widths.exp() * self.unit
        return centres, widths, self.consequents * self.span

    def outputs(self, x: Tensor, rules: tuple[Tensor, Tensor, Tensor] | None = None) -> Tensor:
        """Outputs at states (B, d), of these rules or the full base: (B, m), or (B, J, m)."""
        inputs = self.agent.network_inputs(x)
        flat = inputs.reshape(-1, inputs.shape[-1])
        if rules is None:
            with torch.no_grad():
                out = torch.cat([self.net(part) for part in flat.split(CHUNK)])
        else:
            out = self.net.normalised_firing(flat, rules[:2]) @ rules[2].T
        return out.reshape(*inputs.shape[:-1], -1)

    def scores(self, x: Tensor, outputs: Tensor) -> Tensor:
        """Numbers (B, J) of which the greatest chooses the action; vectors of actions (B, m').

        For a mean in one of J equal parts of a range these are minus the squared distances to the
        middles of the parts, so that edges lie where two are equal.
        """
        if self.decoding["kind"] == "normal":
            mean = outputs[..., : self.decoding["numbers"]]
            count = len(self.agent.choices)
            return -(mean - mean.new_tensor(_middles(count))).square() if count else mean
        codes = x.new_tensor(self.decoding["codes"])
        tails = torch.cat([codes, codes.new_ones(len(codes), 1)], 1)
        shape = (*x.shape[:-1], len(codes), -1)
        features = torch.cat([x.unsqueeze(-2).expand(shape), tails.expand(shape)], -1)
        return (features * (outputs if self.by_action else outputs.unsqueeze(-2))).sum(-1)

    # ------------------------------------------------------------------------------- the start

    def _begin(self, states: NDArray[np.float32], count: int, seed: int) -> None:
        """A rule for each cluster of states, as wide as its neighbours are far."""
        x = self._tensor(states)
        wanted = self.scores(x, self.outputs(x))
        inputs = self.agent.network_inputs(x).reshape(-1, self.net.n_inputs) / self.unit.T
        places, turns = [], []
        for values, axis, unit in zip(inputs.T, self.agent.inputs, self.unit.tolist(), strict=True):
            turn = axis.period / unit[0] / (2 * math.pi)  # radius of the circle of one that wraps
            turns.append(turn)
            places += (
                [turn * f(values / turn) for f in (torch.cos, torch.sin)] if turn else [values]
            )
        lengths = len(places)
        if self.chooses and not self.by_action:
            chosen = functional.one_hot(wanted.argmax(1), wanted.shape[1])
            places += list(APART * chosen.T)
        chance = np.random.default_rng(seed)
        points = torch.stack([place.double() for place in places], 1).numpy()
        found = kmeans2(points, count, iter=30, minit="++", rng=chance)[0][:, :lengths]
        distance = np.linalg.norm(found[:, None] - found, axis=2)
        near = np.sort(distance, 1)[:, 1:3].mean(1) if count > 1 else np.full(1, WIDEST)
        columns, rows = iter(torch.from_numpy(found.T)), []
        for turn in turns:
            first = next(columns)
            rows.append(turn * torch.atan2(next(columns), first) if turn else first)
        self.centres = torch.stack(rows).to(self.unit)
        widths = torch.from_numpy(near).to(self.unit).mul(0.7).clamp(0.5, WIDEST / 2)
        self.log_widths = widths.log().expand_as(self.centres).clone()
        with torch.no_grad():
            self.consequents = (self.net((self.centres * self.unit).T) / self.span.T).T.contiguous()
        for parameter in (self.centres, self.log_widths, self.consequents):
            parameter.requires_grad_()

    # ---------------------------------------------------------------------------------- the fit

    def improve(self, states: NDArray[np.float32], steps: int) -> None:
        """Take steps towards the decisions of the full policy at states (B, d)."""
        x = self._tensor(states)
        target = self.outputs(x)
        scores = self.scores(x, target)
        temperature = self._temperature(scores)
        kinds = self.centres, self.log_widths, self.consequents
        groups = [{"params": [p], "lr": lr} for p, lr in zip(kinds, RATES, strict=True)]
        optimizer = torch.optim.Adam(groups)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        there = torch.empty(0)
        for step in range(steps):
            some = torch.randint(len(x), (min(BATCH, len(x)),), generator=self.chance)
            rules = self.rules()
            outputs = self.outputs(x[some], rules)
            error = ((outputs - target[some]) / self.span.T[0])[..., self.learned]
            loss = WHOLE * error.square().mean()
            said = self.scores(x[some], outputs)
            if self.chooses:
                wanted = scores[some].argmax(1)
                loss = loss + functional.cross_entropy(said / temperature, wanted)
            else:
                loss = loss + 10 * (said - scores[some]).square().mean()
            if self.chooses and not self.by_action:
                centres = rules[0].T.detach()
                if step % EVERY == 0:
                    there = self.scores(centres, self.outputs(centres)).argmax(1)
                for conclusions in (rules[2].T, self.outputs(centres, rules)):
                    said = self.scores(centres, conclusions)
                    loss = loss + READABLE * functional.cross_entropy(said / temperature, there)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            self._bound()

    def _temperature(self, scores: Tensor) -> float:
        """Difference of scores that tells two actions apart: a share of the usual lead."""
        if self.decoding["kind"] == "normal":
            return SHARP / max(1, len(self.agent.choices)) ** 2
        if scores.shape[1] < 2:
            return 1.0
        first, second = scores.topk(2, 1).values.T
        return max(SHARP * (first - second).median().item(), 1e-9)

    @torch.no_grad()
    def _bound(self) -> None:
        """Keep widths and consequents within their limits."""
        least = torch.log(self.net.min_width / self.unit).clamp(min=math.log(NARROWEST))
        self.log_widths.clamp_(max=math.log(WIDEST)).copy_(torch.maximum(self.log_widths, least))
        self.consequents.copy_(self.consequents.clamp(self.low, self.high))

    @torch.no_grad()
    def found(self) -> tuple[Tensor, Tensor, Tensor]:
        """Centres (k, n), widths (k, n) and consequents (k, m), for `SOFNN.replace_rules`."""
        centres, widths, consequents = (part.T.contiguous() for part in self.rules())
        for i, axis in enumerate(self.agent.inputs):
            if axis.period:
                low = axis.low if axis.bounded else -axis.period / 2
                centres[:, i] = low + (centres[:, i] - low).remainder(axis.period)
        return centres, widths, consequents

    def _tensor(self, states: NDArray[np.float32]) -> Tensor:
        return torch.from_numpy(np.asarray(states)).to(self.unit)


def _middles(count: int) -> list[float]:
    """Middles of as many equal parts of [-1, 1]."""
    return [(2 * j + 1 - count) / count for j in range(count)]
