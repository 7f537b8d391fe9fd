"""The weights and prices of the choice of hypotheses, against the mean diversity that they say."""

import numpy as np
import pytest

from chsel.methods.anchored.choosing import weights_and_prices


@pytest.mark.parametrize("reach", [0.0, 1.0, 30.0])
def test_weights_and_prices_are_the_mean_diversity_of_any_hypotheses(reach):
    """Over all candidates that may be the true pose, of which some are equally likely."""
    random = np.random.default_rng(3)
    points = random.normal(size=(12, 4))
    squared = ((points[:, None] - points) ** 2).sum(axis=2)
    energies = np.sort(np.round(random.uniform(0.0, 5.0, 12), 1))
    assert len(np.unique(energies)) < 12
    for count in (1, 2, 5):
        chosen = random.permutation(12)[:count]
        weights, prices = weights_and_prices(squared, energies, reach=reach, count=count)
        total = (weights * squared[:, chosen].min(axis=1)).sum() + prices[chosen].sum()
        diversities = []
        for energy in energies:
            between = squared[np.ix_(energies <= energy + reach, chosen)]
            diversities.append(between.min(axis=1).mean() + between.min(axis=0).mean())
        assert total == pytest.approx(np.mean(diversities), rel=1e-12)
