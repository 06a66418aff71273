"""Validators: good values pass, bad ones are refused with one message, and traced values are judged by their shapes."""

from functools import partial

import jax
import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError


@pytest.mark.parametrize("key", [jax.random.key(0), jax.random.PRNGKey(0)])
def test_keys_of_both_kinds_pass(key):
    checks.key("f()", key)


@pytest.mark.parametrize("key", [0, None, 1.5, np.zeros(2), np.uint32(3), jax.random.split(jax.random.key(0))])
def test_anything_else_raises_with_the_remedy(key):
    with pytest.raises(InputError, match=r"f\(\): key is .*; expected one random key, such as jax.random.key\(0\)"):
        checks.key("f()", key)


def test_functions_that_draw_check_their_key(small_model, demonstration, field, reference):
    cloud = np.asarray(demonstration.points)
    calls = {
        "imitate": lambda: tdf.imitate(small_model, demonstration, cloud, key=0),
        "imitate_batch": lambda: tdf.imitate_batch(small_model, demonstration, [cloud], key=0),
        "optimize": lambda: tdf.optimize(field, reference, 0),
        "box_query": lambda: tdf.box_query(0),
        "gaussian_query": lambda: tdf.gaussian_query(0),
        "gripper_query": lambda: tdf.gripper_query(0),
    }
    for name, call in calls.items():
        with pytest.raises(InputError, match=rf"^{name}\(\): key is 0"):
            call()


# Numbers of traced values are not known yet: only their shapes are checked


def wxyz_xyz(*shape):
    return np.broadcast_to(np.float32([1, 0, 0, 0, 0.1, 0.2, 0.3]), (*shape, 7))


CLOUD = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
# validator, a good value, bad numbers in its shape, bad shapes
VALIDATORS = {
    "number": (partial(checks.number, "f()", "x", least=0, most=1), 0.5, (np.nan, -1.0, 2.0), (np.ones(2),)),
    "positive": (partial(checks.positive, "f()", "x"), 0.5, (np.inf, 0.0), (np.ones((1, 1)),)),
    "vector": (partial(checks.vector, "f()", "x"), np.ones(3), ([0, np.nan, 0],), (np.ones(2), np.ones((1, 3)))),
    "direction": (partial(checks.direction, "f()", "x"), np.ones(3), (np.zeros(3), [np.inf, 0, 0]), (np.ones(4),)),
    "lengths": (partial(checks.lengths, "f()", "x"), np.ones(3), ([1, 0, 1], [1, 1, np.nan]), (np.ones(2), 1.0)),
    "coordinates": (partial(checks.coordinates, "f()", "x"), CLOUD, (CLOUD * np.nan,), (CLOUD[:, :2], CLOUD[:0])),
    "pose": (partial(checks.pose, "f()", "x"), wxyz_xyz(), (np.zeros(7), wxyz_xyz() + np.inf), (wxyz_xyz(1),)),
    "rotations": (partial(checks.rotations, "f()", "x"), np.eye(3), (np.ones((3, 3)), -np.eye(3)), (np.eye(4),)),
    "orientation": (partial(checks.orientation, "f()", "x"), np.eye(3), (np.ones((3, 3)),), (np.eye(2), np.ones(3))),
    "quaternion": (
        partial(checks.orientation, "f()", "x"),
        np.full(4, 0.5),
        (np.ones(4), np.zeros(4), [np.nan] * 4),
        (np.ones(5),),
    ),
    "points": (partial(checks.points, "f()", name="x"), CLOUD, (CLOUD * np.nan, CLOUD * 0), (CLOUD[:20], CLOUD[:, 0])),
    "query": (partial(checks.query, "f()"), CLOUD, (CLOUD * np.inf,), (CLOUD[0], CLOUD[:0])),
}


@pytest.mark.parametrize("name", VALIDATORS)
def test_bad_numbers_and_bad_shapes_are_refused(name):
    check, good, bad_numbers, bad_shapes = VALIDATORS[name]
    np.testing.assert_array_equal(check(good), good)
    for bad in (*bad_numbers, *bad_shapes):
        with pytest.raises(InputError, match=r"^f\(\): .*(x|query points)\b"):
            check(bad)


@pytest.mark.parametrize("name", VALIDATORS)
def test_traced_values_pass_whatever_their_numbers_and_are_refused_by_their_shapes(name):
    check, good, bad_numbers, bad_shapes = VALIDATORS[name]
    for value in (good, *bad_numbers):
        value = np.asarray(value, np.float32)
        with jax.debug_nans(False):
            np.testing.assert_array_equal(jax.jit(check)(value), value)
            np.testing.assert_array_equal(jax.vmap(check)(np.stack([value, value])), [value, value])
    for bad in bad_shapes:
        for transformed in (jax.jit(check), lambda value: jax.vmap(check)(value[None])):
            with pytest.raises(InputError, match=r"^f\(\): .*(x|query points)\b"):
                transformed(np.asarray(bad, np.float32))


def test_traced_numbers_in_a_list_make_a_vector():
    np.testing.assert_array_equal(jax.jit(lambda x: checks.vector("f()", "x", [0.0, x, 1.0]))(2.0), [0, 2, 1])


@pytest.mark.parametrize("value", [0, 6, 1.5, True, "2", None])
def test_counts_are_whole_numbers_within_bounds(value):
    assert checks.count("f()", "x", np.int32(5), most=5) == 5
    with pytest.raises(InputError, match=r"^f\(\): x is .*; expected a whole number from 1 to 5$"):
        checks.count("f()", "x", value, most=5)


@pytest.mark.parametrize("value", [-1, 2**32, 1.0, True, None])
def test_seeds_are_those_that_jax_takes(value):
    assert checks.seed("f()", 2**32 - 1) == 2**32 - 1
    with pytest.raises(InputError, match=r"^f\(\): --seed is .*; expected a whole number from 0 to 4294967295$"):
        checks.seed("f()", value, "--seed")


@pytest.mark.parametrize("value", [3, (1, 2), (1, 2, 0), (1, 2, 3.0), (1, 2, True), "abc", None])
def test_several_counts_are_whole_numbers_of_at_least_one(value):
    assert checks.counts("f()", "x", np.array([1, 2, 3])) == (1, 2, 3)
    with pytest.raises(InputError, match=r"^f\(\): x is .*; expected three whole numbers of at least 1$"):
        checks.counts("f()", "x", value)


def test_an_upper_bound_may_be_left_out():
    assert checks.number("f()", "x", 0.999, 0, below=1) == 0.999
    with pytest.raises(InputError, match=r"^f\(\): x is 1; expected one finite number of 0 or more, less than 1$"):
        checks.number("f()", "x", 1, 0, below=1)


def test_positions_may_have_any_axes():
    for shape in ((3,), (0, 3), (2, 4, 3)):
        assert checks.positions("f()", "x", np.zeros(shape)).shape == shape
    with pytest.raises(InputError, match=r"^f\(\): x has shape \(3, 2\); expected \(..., 3\), metres$"):
        checks.positions("f()", "x", np.zeros((3, 2)))


def test_coordinates_may_be_none_where_the_caller_allows_it():
    assert checks.coordinates("f()", "x", np.zeros((0, 3)), least=0).shape == (0, 3)


def test_choices_may_be_whole_numbers():
    assert checks.choice("f()", "x", 2, (1, 2)) == 2
    for bad in (3, True, "1", 1.0, None, []):
        with pytest.raises(InputError, match=r"^f\(\): x is .*; expected one of 1, 2$"):
            checks.choice("f()", "x", bad, (1, 2))


def test_choices_are_listed():
    assert checks.choice("f()", "x", "b", ("a", "b")) == "b"
    for bad in ("c", 1, None):
        with pytest.raises(InputError, match=r"^f\(\): x is .*; expected one of a, b$"):
            checks.choice("f()", "x", bad, ("a", "b"))
