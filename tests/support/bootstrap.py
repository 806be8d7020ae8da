"""Intervals by a bootstrap over independent runs."""

import torch


def interval(a, b, draws=400):
    """95 % bootstrap interval of the ratio of the mean variances of runs ``a`` and ``b (runs, ...)``."""
    g, ratios = torch.Generator().manual_seed(0), []
    for _ in range(draws):
        i = torch.randint(len(a), (len(a),), generator=g)
        ratios.append(a[i].var(0).mean() / b[i].var(0).mean())
    return torch.stack(ratios).quantile(torch.tensor([0.025, 0.975], dtype=a.dtype)).tolist()
