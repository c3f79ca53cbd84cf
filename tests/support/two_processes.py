"""Run by torchrun from test_classify_training: what two processes compute together, then a whole training run."""

from __future__ import annotations

import os
import sys

import torch
import torch.distributed as dist

from dpcli.classify.network.sync_norm import SyncNorm


def check_norm(target: str) -> None:
    """Each process norms its half of a batch; the first one writes outputs, gradients and statistics of both halves."""
    # Its own file, not torchrun's store: a second group there could read the addresses of the first, already gone.
    rank = int(os.environ["RANK"])
    dist.init_process_group("gloo", init_method=f"file://{target}.store", rank=rank, world_size=2)
    values = torch.linspace(-1, 1, 6 * 3 * 2, dtype=torch.float64).sin().view(6, 3, 2) * 3
    mine = values[3 * rank : 3 * rank + 3].clone().requires_grad_()
    norm = SyncNorm(3, eps=1e-3).double()
    out = norm(mine)
    (out**3).sum().backward()
    dist.all_reduce(norm.weight.grad)
    both = [[torch.empty_like(mine) for _ in range(2)] for _ in range(2)]
    dist.all_gather(both[0], out.detach())
    dist.all_gather(both[1], mine.grad)
    if rank == 0:
        torch.save(
            [values, torch.cat(both[0]), torch.cat(both[1]), norm.weight.grad, norm.running_mean, norm.running_var],
            target,
        )
    dist.destroy_process_group()


if __name__ == "__main__":
    check_norm(sys.argv[1])
    from dpcli.cli.app import main

    sys.exit(main(sys.argv[2:]))
