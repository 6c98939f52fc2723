"""Intervals cover the truth as often as they say, and verdicts err as rarely."""

import math

import numpy as np
import pytest
from conftest import fixed_interval
from scipy import stats

from sofnn_torch.studies import statistics
from sofnn_torch.studies.statistics import FAILS, HOLDS, OPEN, judge, verdicts


def covered(measured, truth):
    return measured.low <= truth <= measured.high


def steps(rng, seeds):
    """Mean steps of seeds as studies find them: most alike, a few much slower."""
    return 480 + rng.lognormal(3, 1, seeds)


STEPS = 480 + math.exp(3)  # their median


def test_medians_come_with_intervals_that_contain_them():
    data = np.random.default_rng(0).normal(500, 30, 40)
    middle = statistics.median(data)
    assert middle.value == np.median(data)
    assert data.min() < middle.low < middle.value < middle.high < data.max()
    again = statistics.median(data)
    assert (again.low, again.high) == (middle.low, middle.high)  # seeded
    many = statistics.median(np.tile(data, 25))
    assert middle.high - middle.low > 2 * (many.high - middle.value)
    alike = statistics.median(np.full(5, 7.0))
    assert (alike.value, alike.low, alike.high) == (7, 7, 7)
    assert math.isnan(statistics.median(np.zeros(0)).value)
    assert middle.at(0.5)[0] > middle.low  # less sure, narrower


def test_of_fewer_than_five_seeds_there_is_no_interval():
    for count in (1, 2, 4):
        data = np.arange(count) + 1.0
        for found in (statistics.median(data), statistics.mean(data)):
            assert math.isnan(found.low) and found.values == tuple(data)
        assert math.isnan(statistics.ratio(data, np.arange(9) + 1.0).high)
        assert math.isnan(statistics.share(data, 4).low)
    assert not math.isnan(statistics.median(np.arange(5.0)).low)


def test_ratios_are_of_medians_and_means_are_means():
    skewed, even = np.array([1.0, 1.0, 1.0, 10.0, 12.0]), np.array([2.0, 2.0, 2.0, 2.0, 2.0])
    assert statistics.ratio(skewed, even).value == 0.5
    assert statistics.mean(skewed).value == 5 and statistics.median(skewed).value == 1


def test_the_interval_of_a_mean_of_many_is_that_of_a_normal_distribution():
    data = np.random.default_rng(3).normal(0, 1, 900)
    estimate = statistics.mean(data)
    half = 1.96 * data.std() / math.sqrt(len(data))
    assert (estimate.high - estimate.low) / 2 == pytest.approx(half, rel=0.06)


def test_a_share_without_a_miss_ends_where_it_would_be_missed_once_in_forty():
    found = statistics.share(np.full(20, 20), 20)
    assert found.value == found.high == 1
    assert found.low == pytest.approx(0.025 ** (1 / 400))  # the chance of 400 hits is 2.5 %


def test_shares_are_exact_and_wider_if_seeds_differ():
    for successes, count in ((9, 10), (0, 12), (390, 400)):
        expected = stats.binomtest(successes, count).proportion_ci(0.9, "exact")
        found = statistics.proportion(successes, count)
        assert found.at(0.9) == pytest.approx((expected.low, expected.high), abs=1e-9)
    even, uneven = np.full(5, 16), np.array([20, 20, 20, 20, 0])
    narrow, wide = statistics.share(even, 20), statistics.share(uneven, 20)
    assert (narrow.low, narrow.high) == pytest.approx(statistics.proportion(80, 100).at(0.95))
    assert wide.value == narrow.value and wide.low < narrow.low and wide.high > narrow.high


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.6, 0.9), HOLDS),
        ((0.1, 0.4), FAILS),
        ((0.4, 0.6), OPEN),
        ((math.nan, math.nan), OPEN),
    ],
)
def test_verdicts_are_of_whole_intervals(interval, verdict):
    assert judge(fixed_interval(0.5, *interval), 0.5, 1) == verdict
    assert verdicts([(fixed_interval(0.5, *interval), 0.5, 1)]) == [verdict]


def test_the_doubt_of_a_share_is_the_binomial_p_value():
    # 9 of 10 against a half: both tails of 11 in 1024.
    found = statistics.doubt(statistics.proportion(9, 10), 0.5, 1)
    assert found == pytest.approx(2 * 11 / 1024, rel=1e-3)
    assert statistics.doubt(fixed_interval(math.nan), 0, 1) == 1


def test_verdicts_of_a_family_follow_holm():
    shares = [statistics.proportion(k, 10) for k in (9, 10, 5, 10)]
    # p: 0.0215, 0.002, 1, 0.002; bounds in their order: 0.0125, 0.0167, 0.025, 0.05.
    assert verdicts([(share, 0.5, 1) for share in shares]) == [HOLDS, HOLDS, OPEN, HOLDS]
    # With one claim more 0.0215 exceeds its bound of 0.0167.
    assert verdicts([(share, 0.5, 1) for share in [*shares, shares[2]]])[0] == OPEN
    assert judge(shares[0], 0.5, 1) == HOLDS  # alone it would hold


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [5, 10, 20])
def test_intervals_of_medians_cover_what_they_promise(seeds):
    rng = np.random.default_rng(seeds)
    hits = [covered(statistics.median(steps(rng, seeds)), STEPS) for _ in range(1000)]
    assert np.mean(hits) > 0.92, np.mean(hits)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [(5, 5), (10, 5), (10, 10), (20, 20)])
def test_intervals_of_ratios_cover_what_they_promise(seeds):
    rng = np.random.default_rng(sum(seeds))
    samples = ((steps(rng, seeds[0]), steps(rng, seeds[1])) for _ in range(1000))
    hits = [covered(statistics.ratio(*pair), 1.0) for pair in samples]
    assert np.mean(hits) > 0.92, np.mean(hits)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [5.0, 500.0])  # of seeds: widely apart, all alike
def test_intervals_of_shares_cover_what_they_promise_also_if_seeds_differ(spread):
    rng, truth = np.random.default_rng(1), 0.9
    chances = rng.beta(spread * truth, spread * (1 - truth), (1000, 20))
    hits = [
        covered(statistics.share(successes, 20), truth) for successes in rng.binomial(20, chances)
    ]
    assert np.mean(hits) > 0.92, np.mean(hits)


def test_an_interval_of_five_seeds_covers_about_nine_times_in_ten():
    rng = np.random.default_rng(0)
    hits = [covered(statistics.median(steps(rng, 5)), STEPS) for _ in range(100)]
    assert 0.86 <= np.mean(hits) <= 1.0
