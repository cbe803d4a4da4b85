"""Networks that differ by chance only: the one nearest to the others is taken, and their scatter is stated."""

import dataclasses

import numpy as np
import pytest

from lfpiv.calibration.committee import (
    MOST_NETWORKS,
    NETWORKS,
    distance_of_halves,
    nearest_to_others,
    smooth_departure,
    train_several,
)
from lfpiv.calibration.training import TrainingSettings, train
from lfpiv.geometry.optics import random_on_pupil

REGION_MM, PUPIL_MM = np.array([[-2.0, -2, -1], [2, 2, 1]]), 12.5
BORDER_MM = 0.3  # error of a network at one border, where no sample shows it
LENGTH_MM = 1e4  # unit in which errors are far below 1, so that no further network is trained
DRAWS = 200
CHOSEN_SHARE = 0.35  # relative: 0.18 with three networks over 4000 draws, of 200 draws 0.1 by chance
SHIFT_MM = 0.004  # of a network, along one output, against two equal ones


def places(points):
    x, y, z, u, v = points.T
    return np.stack([x + 0.05 * z * u + 0.01 * x * z, y + 0.05 * z * v], axis=1)


@pytest.fixture(scope="module")
def trainings():
    rng = np.random.default_rng(5)
    rays = np.hstack([rng.uniform(*REGION_MM, (1500, 3)), random_on_pupil(PUPIL_MM, 1500, rng)])
    return [train(rays, places(rays), TrainingSettings(hidden=(10,), epochs=30, seed=seed)) for seed in range(3)]


def shifted(training, by_mm):
    network = training.network
    return dataclasses.replace(
        training, network=dataclasses.replace(network, output_centre=network.output_centre + by_mm)
    )


def test_an_outlier_is_never_taken(trainings):
    wrong = shifted(trainings[0], BORDER_MM)
    for at in range(3):
        some = [*trainings[1:]]
        some.insert(at, wrong)
        assert nearest_to_others(some, REGION_MM, PUPIL_MM, seed=0).training is not wrong


def test_the_scatter_is_the_error_of_a_network(trainings):
    one = trainings[0]
    chosen = nearest_to_others([one, shifted(one, [SHIFT_MM, 0])], REGION_MM, PUPIL_MM, seed=0)
    assert chosen.scatter == pytest.approx(SHIFT_MM / np.sqrt(2), rel=1e-9)
    rng = np.random.default_rng(7)
    rays = np.hstack([rng.uniform(*REGION_MM, (4000, 3)), random_on_pupil(PUPIL_MM, 4000, rng)])
    errors = [np.linalg.norm(one.network(rays) - places(rays), axis=1).mean() for one in trainings]
    found = nearest_to_others(trainings, REGION_MM, PUPIL_MM, seed=0).scatter
    assert min(errors) / 2 < found < 2 * max(errors)  # three networks tell a mean error within a factor of two


@pytest.mark.parametrize("count", [NETWORKS, MOST_NETWORKS])
def test_the_error_of_the_chosen_network_is_stated(trainings, count):
    """Errors of networks have long tails: Student's distribution, 2 degrees of freedom."""
    random, found = np.random.default_rng(9), []
    for draw in range(DRAWS):
        errors = SHIFT_MM * random.standard_t(2, (count, 2))
        several = [shifted(trainings[0], error) for error in errors]
        chosen = nearest_to_others(several, REGION_MM, PUPIL_MM, seed=draw)
        own = next(np.linalg.norm(e) for one, e in zip(several, errors, strict=True) if one is chosen.training)
        found.append((chosen.error, own))
    stated, true = np.median(found, axis=0)
    assert abs(stated / true - 1) < CHOSEN_SHARE


@pytest.mark.parametrize(("apart_mm", "expected"), [(0.0, NETWORKS), (BORDER_MM, MOST_NETWORKS)])
def test_more_networks_are_trained_while_they_scatter(trainings, apart_mm, expected):
    seeds = []

    def trained(seed):
        seeds.append(seed)
        return dataclasses.replace(shifted(trainings[0], apart_mm * 2.0 ** len(seeds)), seconds=1.0)

    chosen = train_several(trained, REGION_MM, PUPIL_MM, seed=4, unit=1.0)
    assert seeds == list(range(4, 4 + expected)) and chosen.training.seconds == expected
    assert (chosen.scatter >= chosen.training.sigma_nor) == (apart_mm > 0)


def test_the_scatter_is_stated_in_the_unit_of_the_errors(trainings):
    several = iter(trainings)
    chosen = train_several(lambda _: next(several), REGION_MM, PUPIL_MM, seed=0, unit=LENGTH_MM)
    alone = nearest_to_others(trainings, REGION_MM, PUPIL_MM, seed=0)
    assert chosen.scatter == pytest.approx(alone.scatter / LENGTH_MM)


DOTS, LABELS, NOISE_MM = 400, 12, 0.01


def noisy_labels(random):
    """Return dots, rays and labels; the noise is shared by the labels of a dot."""
    dot = np.repeat(np.arange(DOTS), LABELS)
    points = random.uniform(*REGION_MM, (DOTS, 3))[dot]
    rays = np.hstack([points, random_on_pupil(PUPIL_MM, len(dot), random)])
    return dot, rays, places(rays) + NOISE_MM * random.normal(size=(DOTS, 2))[dot]


def test_half_the_distance_of_two_halves_is_the_error_that_noise_makes():
    """A linear fit of ten terms has the error NOISE sqrt(10 / dots) per coordinate."""
    found = []
    for seed in range(20):
        dot, rays, labels = noisy_labels(np.random.default_rng(seed))

        def terms(points, pupil):
            x, y, z = points.T
            return np.column_stack([np.ones(len(x)), points, points**2, x * y, x * z, y * z])

        def fit(part, rays=rays, labels=labels, terms=terms):
            smooth = np.linalg.lstsq(terms(rays[part, :3], 0), (labels - places(rays))[part], rcond=None)[0]
            return lambda points, pupil: terms(points, pupil) @ smooth

        found.append(distance_of_halves(fit, dot, REGION_MM, PUPIL_MM, seed, np.inf))
    expected = NOISE_MM * np.sqrt(10 / DOTS) * np.sqrt(np.pi / 2)
    assert np.mean(found) == pytest.approx(expected, rel=0.15)  # of twenty draws, each with ten unknowns
    assert np.isnan(distance_of_halves(fit, dot % 30, REGION_MM, PUPIL_MM, 0, np.inf))


@pytest.mark.parametrize(("held_out", "expected"), [(10.0, 9.0), (8.0, 1.0)])
def test_halves_further_apart_than_held_out_dots_allow_are_outvoted(held_out, expected):
    """The first half is displaced by 18, and half of the distance counts."""
    displaced = iter([18.0, 0.0, 2.0, 0.0, 0.0, 2.0, 2.0, 0.0, 0.0, 2.0])

    def fit(part):
        shift = next(displaced)
        return lambda points, pupil: np.column_stack([np.full(len(points), shift), np.zeros(len(points))])

    assert distance_of_halves(fit, np.arange(100), REGION_MM, PUPIL_MM, 0, held_out) == pytest.approx(expected)


def test_a_mapping_that_does_not_follow_its_labels_departs_smoothly():
    dot, rays, labels = noisy_labels(np.random.default_rng(2))
    assert smooth_departure(rays, labels - places(rays), dot) == 0
    bent = 0.02 * (rays[:, :1] / 2) ** 2 * [1.0, 0.0]
    assert smooth_departure(rays, labels + bent - places(rays), dot) == pytest.approx(0.02 / 3, rel=0.3)
    assert smooth_departure(rays[:20], bent[:20], dot[:20]) == 0  # too few to tell
