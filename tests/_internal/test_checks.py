"""A number is not a key: every function that draws says so, and takes both kinds of jax's keys."""

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
def test_anything_else_is_told_how_to_make_one(key):
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
