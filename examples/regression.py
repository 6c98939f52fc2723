"""Fit a function of two inputs by torch.optim while the network grows.

    python examples/regression.py

The network has no rule at first and adds one wherever a sample is covered by none (equation 3).
Adam moves what all rules conclude, where they lie and how wide they are, each kind at a rate of its
own, and goes on through the growth: the network tells it of every new block of rules.
"""

import torch

from sofnn_torch import SOFNN, Axis

RATES = {"centres": 0.002, "widths": 0.002, "consequents": 0.02}


def target(x: torch.Tensor) -> torch.Tensor:
    """A wave that grows along the second input: sin(6 a) b. Shape: (B, 2) to (B, 1)."""
    return torch.sin(6 * x[:, :1]) * x[:, 1:]


def fit(steps: int = 400, batch: int = 64, seed: int = 0) -> SOFNN:
    """A network that has seen so many batches of random samples.

    Args:
        steps: steps of the optimizer.
        batch: samples for each.
        seed: of the samples.
    """
    generator = torch.Generator().manual_seed(seed)
    net = SOFNN([Axis("a", low=0, high=1), Axis("b", low=0, high=1)], 1, width=0.12, theta=0.4)
    optimizer = None
    for _ in range(steps):
        x = torch.rand(batch, 2, generator=generator)
        net.grow(x[0])
        if optimizer is None:
            optimizer = torch.optim.Adam(net.parameter_groups(**RATES))
            net.follow(optimizer)
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(net(x), target(x)).backward()
        optimizer.step()
    return net


def main() -> None:
    """Fit and print how well, beside the error of the best constant."""
    net = fit()
    steps = torch.linspace(0, 1, 50)
    x = torch.cartesian_prod(steps, steps)
    wanted = target(x)
    with torch.no_grad():
        error = (net(x) - wanted).square().mean().sqrt().item()
    constant = wanted.std(correction=0).item()
    print(f"{net.n_rules} rules, error {error:.4f} (root mean square); a constant: {constant:.4f}")


if __name__ == "__main__":
    main()
