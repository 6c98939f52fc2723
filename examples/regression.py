"""Fit a function of two inputs with an ordinary optimizer of torch while the network grows.

    python examples/regression.py

The optimizer is made before the first rule. It follows the network: each new rule is learned from
the moment it is there, and what Adam remembers of the others stays with them, also where rules are
dropped.
"""

import torch

from sofnn_torch import SOFNN


def target(x: torch.Tensor) -> torch.Tensor:
    """A bump and a wave on the unit square. Shape: (B, 2) to (B, 1)."""
    bump = torch.exp(-20 * (x - 0.5).square().sum(1, keepdim=True))
    return bump + 0.3 * torch.sin(6 * x[:, :1])


def main() -> None:
    """Train on 600 batches of 64 states; print the error against that of the best constant."""
    torch.manual_seed(0)
    net = SOFNN(2, 1, width=0.15, theta=0.4)
    rates = net.parameter_groups(centres=1e-3, widths=1e-3, consequents=0.02)
    optimizer = torch.optim.Adam(rates)
    net.follow(optimizer)
    for step in range(600):
        x = torch.rand(64, 2)
        for state in x[:4] if step < 400 else ():
            net.observe(state)  # adds a rule where none fires by theta
        if step == 400:
            grown = net.n_rules
            net.prune(net.usage > 0.4 * net.usage.median())  # those that hardly ever fired
        optimizer.zero_grad()
        (net(x) - target(x)).square().mean().backward()
        optimizer.step()
    x = torch.rand(2000, 2)
    with torch.no_grad():
        error = (net(x) - target(x)).square().mean().sqrt().item()
    constant = target(x).std().item()
    print(f"{grown} rules, {net.n_rules} kept, rms error {error:.3f}, a constant {constant:.3f}")


if __name__ == "__main__":
    main()
