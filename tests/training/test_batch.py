"""Batches: pairs of objects, scaled and centred together with their queries and places, as sensors give them."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tdf_jax.training import batch, dataset
from tdf_jax.training.batch import DIAGONALS, PAIR_SPREAD, draw, validation_pairs
from tdf_jax.training.dataset import DataSet, Recipe

SIZES = {"pairs": 3, "points": 200, "queries": 50, "box": 12, "num_poses": 6}


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects")
    dataset.build(Recipe(seed=5, objects=3, validation=2, points=1200, queries=1000, cameras=6), folder, progress=False)
    return dataset.load(folder)[0]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(batch, "DENSE_POINTS", 1000)
    monkeypatch.setattr(batch, "SPARSE_POINTS", (250, 1000))


def drawn(objects, seed, corruption=0.0, **changes):
    return draw(objects, np.random.default_rng(seed), corruption=corruption, **(SIZES | changes))


def pairs_of(batch_):
    """Every (object, its partner) of a batch as dictionaries of their fields."""
    fields = [field.name for field in dataclasses.fields(batch_)]
    for pair in range(len(batch_.clouds)):
        for which in range(2):
            yield tuple({name: getattr(batch_, name)[pair, side] for name in fields} for side in (which, 1 - which))


def source(objects, sample):
    """Which object a complete cloud is of, and its diagonal: by its extents."""
    shapes = np.ptp(objects.surface, axis=1)
    extents = np.ptp(sample["clouds"], axis=0)
    ratios = extents / shapes
    index = np.argmin(np.ptp(ratios, axis=1) / ratios.mean(axis=1))
    return index, ratios[index].mean()


def test_batches_are_a_function_of_the_generator(objects):
    first, again, other = drawn(objects, 0, 0.5), drawn(objects, 0, 0.5), drawn(objects, 1, 0.5)
    for field in dataclasses.fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(again, field.name))
        assert getattr(first, field.name).dtype == np.float32
    assert not np.array_equal(first.clouds, other.clouds)
    shapes = [getattr(first, field.name).shape for field in dataclasses.fields(first)]
    assert shapes == [
        (3, 2, 200, 3),
        (3, 2, 50, 3),
        (3, 2, 50),
        (3, 2, 3),
        (3, 2),
        (3, 2, 12, 3),
        (3, 2, batch.QUARTERS + 5, 12, 3),
    ]


def test_everything_of_an_object_is_scaled_and_centred_together(objects):
    sizes = []
    for sample, partner in pairs_of(drawn(objects, 0, pairs=6)):
        index, size = source(objects, sample)
        sizes.append((size, source(objects, partner)[1]))
        np.testing.assert_allclose(sample["clouds"].mean(axis=0), 0, atol=1e-7)
        place = (sample["queries"] - sample["centres"]) / size  # in the object's frame, at unit diagonal
        nearest = np.linalg.norm(place[:, None] - objects.queries[index], axis=-1)
        assert nearest.min(axis=1).max() < 0.01
        assert np.mean(objects.inside[index][nearest.argmin(axis=1)] == sample["inside"]) > 0.95
    sizes = np.array(sizes)
    assert sizes.min() > 0.8 * DIAGONALS[0] and sizes.max() < 1.2 * DIAGONALS[1] and np.ptp(sizes) > 0.05
    assert np.abs(np.log(sizes[:, 0] / sizes[:, 1])).max() < 2 * PAIR_SPREAD + 0.05  # a pair is of about one size


def rigid(x, y):
    """T with y = T x of point sets (points, 3), by Kabsch, and the largest distance left."""
    a, b = x.mean(axis=0), y.mean(axis=0)
    u, _, v = np.linalg.svd((y - b).T @ (x - a))
    R = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, b - R @ a
    return T, np.abs(x @ R.T + T[:3, 3] - y).max()


def test_the_right_pose_is_the_same_place_of_the_partner_and_the_others_are_not(objects):
    """The demonstrated and first offered box are rigid copies from place to place; positions identify the places."""
    for sample, partner in pairs_of(drawn(objects, 2, pairs=8)):
        (index, size), (other, other_size) = source(objects, sample), source(objects, partner)
        T, left = rigid(sample["demonstrated"], sample["offered"][0])
        assert left < 1e-5
        expected = []
        for place, other_place in zip(objects.places[index].copy(), objects.places[other].copy()):
            place[:3, 3] = place[:3, 3] * size + sample["centres"]
            other_place[:3, 3] = other_place[:3, 3] * other_size + partner["centres"]
            expected.append(other_place @ np.linalg.inv(place))
        assert min(np.abs(T - motion).max() for motion in expected) < 0.01
        for equal in sample["offered"][1 : batch.QUARTERS]:  # of an object without symmetry there is one right pose
            np.testing.assert_array_equal(equal, sample["offered"][0])
        for wrong in sample["offered"][batch.QUARTERS :]:
            assert rigid(sample["demonstrated"], wrong)[1] < 1e-5
            moved = np.linalg.norm(wrong - sample["offered"][0], axis=-1).max()
            assert moved > 0.003 * size


def test_corrupted_clouds_are_partial_sparse_or_noisy(objects):
    """The mean of a cloud seen from one side is off the object's; that of a complete one is not."""
    off = {}
    for corruption in (0.0, 1.0):
        samples = [sample for sample, _ in pairs_of(drawn(objects, 4, corruption, pairs=30))]
        spread = [np.linalg.norm(np.ptp(sample["clouds"], axis=0)) for sample in samples]
        off[corruption] = np.array([np.linalg.norm(sample["centres"]) for sample in samples]) / spread
    assert off[0.0].max() < 0.06
    assert 0.1 < np.mean(off[1.0] > 0.07) < 0.6


def test_some_clouds_have_points_astray(objects, monkeypatch):
    for share in ("PARTIAL_SHARE", "SPARSE_SHARE", "NOISY_SHARE"):
        monkeypatch.setattr(batch, share, 0.0)
    monkeypatch.setattr(batch, "OUTLIERS", 0.05)  # of 1000 points: enough to be told by their distance
    astray = {}
    for corruption in (0.0, 1.0):
        clouds = [batch._sensed(objects, np.random.default_rng(seed), 0, corruption, 200) for seed in range(30)]
        astray[corruption] = [np.sum(cKDTree(objects.surface[0]).query(cloud)[0] > 0.01) for cloud in clouds]
    assert not np.any(astray[0.0])
    assert 0.05 < np.mean(np.array(astray[1.0]) > 2) < 0.4
    assert np.max(astray[1.0]) <= 50


def test_validation_pairs_show_every_object_once_at_one_size(objects):
    objects = dataclasses.replace(
        objects, **{f.name: getattr(objects, f.name)[:2] for f in dataclasses.fields(objects)}
    )
    full, view = (validation_pairs(objects, 100, 12, 6, one_view)[0] for one_view in (False, True))
    assert full.queries.shape == (2, 500, 3)
    np.testing.assert_array_equal(full.inside, objects.inside[:, :500])
    extents = np.ptp(full.clouds, axis=1) / np.ptp(objects.surface, axis=1)
    np.testing.assert_allclose(extents, batch.VALIDATION_DIAGONAL, rtol=0.08)
    seen = [objects.surface[k][objects.visible[k, 0]] * batch.VALIDATION_DIAGONAL for k in range(2)]
    for cloud, centre, points in zip(view.clouds, view.centres, seen):
        distances = np.linalg.norm((cloud - centre)[:, None] - points, axis=-1)
        assert distances.min(axis=1).max() < 1e-6


# ---- symmetric objects, and several sources ----


def many(objects, folds, sources):
    """The given objects repeated, with these symmetries and sources; a batch does not depend on their shapes."""
    indices = np.resize(np.arange(len(objects.surface)), len(folds))
    repeated = {field.name: getattr(objects, field.name)[indices] for field in dataclasses.fields(DataSet)}
    return DataSet(**(repeated | {"fold": np.array(folds, np.int8), "source": np.array(sources)}))


def drawn_indices(data, monkeypatch, pairs, seed=0):
    """Which objects a batch is of, (pairs, 2)."""
    asked, sensed = [], batch._sensed

    def noted(data, rng, index, corruption, points):
        asked.append(int(index))
        return sensed(data, rng, index, corruption, points)

    monkeypatch.setattr(batch, "_sensed", noted)
    made = drawn(data, seed, pairs=pairs, points=6, queries=2, box=2, num_poses=2)
    return np.reshape(asked, (pairs, 2)), made


def test_sources_are_drawn_alike_however_many_objects_they_have(objects, monkeypatch):
    data = many(objects, [1] * 12, [0] + [1] * 9 + [2] * 2)
    found, _ = drawn_indices(data, monkeypatch, 400)
    shares = np.bincount(data.source[found[:, 0]]) / 400
    np.testing.assert_allclose(shares, 1 / 3, atol=0.1)  # four standard deviations
    assert set(found[:, 0]) == set(range(12))


def test_partners_are_of_the_same_source_and_symmetry(objects, monkeypatch):
    folds, sources = [0, 2, 0, 2, 0, 1, 1, 0], [0, 0, 0, 0, 1, 1, 1, 1]
    data = many(objects, folds, sources)
    found, made = drawn_indices(data, monkeypatch, 200)
    for first, partner in found:
        assert (folds[first], sources[first]) == (folds[partner], sources[partner])
    met = {tuple(pair) for pair in found.tolist()}
    assert met == {(a, b) for kind in ((0, 2), (1, 3), (4, 7), (5, 6)) for a in kind for b in kind}
    np.testing.assert_array_equal(made.fold, np.array(folds)[found])


def test_kinds_of_a_source_are_drawn_alike_however_many_objects_they_have(objects, monkeypatch):
    data = many(objects, [0] * 9 + [2] + [4] * 2 + [1] * 3, [0] * 12 + [1] * 3)
    found, _ = drawn_indices(data, monkeypatch, 600)
    numbers = np.bincount(data.kind[found[:, 0]]) / 600
    expected = [1 / 2 if (data.source[members] == 1).all() else 1 / 6 for members in data.kinds]
    np.testing.assert_allclose(numbers, expected, atol=0.07)  # four standard deviations


@pytest.mark.parametrize(
    ("fold", "turns"), [(0, (0, 90, 180, 270)), (1, (0, 0, 0, 0)), (2, (0, 0, 180, 0)), (4, (0, 90, 180, 270))]
)
def test_the_right_pose_is_offered_at_every_quarter_turn_that_a_symmetry_allows(objects, fold, turns):
    """About the object's own axis, which a cloud seen from one side does not have its mean on."""
    data = many(objects, [fold] * 3, [0] * 3)
    off_axis = 0.0
    for sample, partner in pairs_of(drawn(data, 3, corruption=1.0, pairs=6)):
        centre = partner["centres"].astype(float)
        off_axis = max(off_axis, np.linalg.norm(centre[:2]))
        right = sample["offered"][0].astype(float)
        for turn, offered in zip(turns, sample["offered"][: batch.QUARTERS], strict=True):
            expected = Rotation.from_euler("z", turn, degrees=True).apply(right - centre) + centre
            np.testing.assert_allclose(offered, expected, atol=1e-6)
    assert off_axis > 0.01


@pytest.fixture
def diagonal(monkeypatch):
    """Of every pair, metres."""
    for name in ("DIAGONALS", "USUAL_DIAGONALS"):
        monkeypatch.setattr(batch, name, (0.2, 0.2))
    return 0.2


def least_distance(wrong, right, centre, fold):
    """RMS distance of a pose's query points from those of the nearest right pose, after any allowed turn."""
    angles = np.arange(fold or 720) * 2 * np.pi / (fold or 720)
    turns = Rotation.from_euler("z", angles[:, None]).as_matrix()
    copies = np.einsum("tij,pj->tpi", turns, right - centre) + centre
    return np.sqrt(np.mean(np.sum((copies - wrong) ** 2, axis=-1), axis=-1)).min()


@pytest.mark.parametrize("fold", [0, 2, 4])
def test_wrong_poses_are_wrong_for_every_turn_a_symmetry_allows(objects, diagonal, monkeypatch, fold):
    """Wrong poses are not equivalent to the right one, though all are turned about the axis and some moved off it."""
    monkeypatch.setattr(batch, "FIRST_SHARE", 0.0)  # of a mug, the place that is not on the axis
    monkeypatch.setattr(batch, "REMOTE_SHARE", 0.0)
    offered_turns = []

    def turned(rng, right, diagonal):
        wrong, angle = right.copy(), rng.choice([0, 2, 3, 4, 5]) * np.pi / 4
        offered_turns.append(round(np.degrees(angle)))
        wrong[:3, :3] = Rotation.from_euler("z", angle).as_matrix() @ right[:3, :3]
        wrong[:3, 3] += rng.choice([0.0, 0.003, 0.05]) * np.array([0, 0, 1])
        return wrong

    monkeypatch.setattr(batch, "_wrong", turned)
    bases = dataclasses.replace(many(objects, [fold] * 3, [0] * 3), places=objects.places[:, [0, 2, 2]])
    found = []
    for sample, partner in pairs_of(drawn(bases, 1, pairs=12, num_poses=5)):
        right, wrong = sample["offered"][0].astype(float), sample["offered"][batch.QUARTERS :].astype(float)
        found += [least_distance(one, right, partner["centres"], fold) for one in wrong]
    assert np.min(found) > batch.MIN_WRONG * diagonal - 1e-4
    assert set(offered_turns) == {0, 90, 135, 180, 225}
    assert len(offered_turns) > len(found)  # some were thrown away


@pytest.mark.parametrize("fold", [0, 2, 4])
def test_wrong_poses_as_training_draws_them_are_wrong_for_every_turn(objects, diagonal, fold, monkeypatch):
    monkeypatch.setattr(batch, "NEAR_ANGLES", (0.5, 90.0))
    monkeypatch.setattr(batch, "NEAR_DISTANCES", (0.001, 0.3))
    data = many(objects, [fold] * 3, [0] * 3)
    found = [
        least_distance(wrong.astype(float), sample["offered"][0].astype(float), partner["centres"], fold)
        for sample, partner in pairs_of(drawn(data, 2, pairs=12, num_poses=12))
        for wrong in sample["offered"][batch.QUARTERS :]
    ]
    assert np.min(found) > batch.MIN_WRONG * diagonal - 1e-5
    assert np.mean(np.array(found) < 0.1 * diagonal) > 0.05  # not only far ones


def test_of_objects_without_symmetry_turned_poses_and_close_ones_are_wrong(objects, diagonal, monkeypatch):
    """They are taken as they are drawn."""
    asked = []

    def turned(rng, right, diagonal):
        wrong = right.copy()
        wrong[:3, :3] = Rotation.from_euler("z", [180, 1][len(asked) % 2], degrees=True).as_matrix() @ right[:3, :3]
        asked.append(wrong)
        return wrong

    monkeypatch.setattr(batch, "_wrong", turned)
    made = drawn(many(objects, [1] * 3, [0] * 3), 1, pairs=2, num_poses=5)
    assert len(asked) == 2 * 2 * 4  # none was drawn again
    assert (made.fold == 1).all()


def test_validation_pairs_are_of_one_kind_and_tell_their_symmetry(objects):
    data = many(objects, [0, 1, 0, 1, 2, 1], [0, 0, 0, 0, 0, 1])
    pairs = validation_pairs(data, 100, 12, 6, one_view=False)
    assert len(pairs) == 2  # the two-fold one and the one of another source have no partner
    for pair, (a, b) in zip(pairs, ((0, 2), (1, 3)), strict=True):
        np.testing.assert_array_equal(pair.inside, data.inside[[a, b], :500])
        np.testing.assert_array_equal(pair.fold, data.fold[[a, b]])
        assert pair.fold.dtype == np.float32 and pair.fold.shape == (2,)
