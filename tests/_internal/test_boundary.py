"""What reaches a public function of the caller's settings, traced values and arrays of other libraries."""

import dataclasses
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdf_jax._internal import boundary
from tdf_jax._internal.boundary import host, own_settings, plain_array, public
from tdf_jax._internal.errors import InputError

SETTINGS = {
    "jax_numpy_rank_promotion": lambda: jax.numpy_rank_promotion("raise"),
    "jax_numpy_dtype_promotion": lambda: jax.numpy_dtype_promotion("strict"),
    "jax_transfer_guard_host_to_device": lambda: jax.transfer_guard("disallow"),
    "jax_transfer_guard_device_to_device": lambda: jax.transfer_guard("disallow_explicit"),
    "jax_transfer_guard_device_to_host": lambda: jax.transfer_guard_device_to_host("log"),
    "jax_debug_infs": lambda: jax.debug_infs(True),
}


class Tensor:
    """As a tensor of PyTorch that requires a gradient, on a device of its own."""

    def __init__(self, values, attached=True, elsewhere=False):
        self.values, self.attached, self.elsewhere = values, attached, elsewhere

    def detach(self):
        return Tensor(self.values, False, self.elsewhere)

    def cpu(self):
        return Tensor(self.values, self.attached)

    def __array__(self, dtype=None, copy=None):
        if self.attached:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy() instead.")
        if self.elsewhere:
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first.")
        return np.asarray(self.values, dtype)


class Table:
    """As a DataFrame of pandas."""

    def __init__(self, columns):
        self.columns = list(columns)
        self.values = columns

    def __getitem__(self, names):
        return Table({name: self.values[name] for name in names})

    def __array__(self, dtype=None, copy=None):
        return np.stack([np.asarray(self.values[name]) for name in self.columns], axis=1)


class Broken:
    def __array__(self, dtype=None, copy=None):
        raise BufferError("gone\nand more")


@dataclasses.dataclass
class Holder:
    """A dataclass that is no pytree, as `Demonstration` is none."""

    points: object


@public
def values(x, *more, scale=1.0, others=(), **rest):
    """What arrives."""
    return {"x": x, "more": more, "scale": scale, "others": others, **rest}


@public
def summed(x, offset=0):
    return float(np.sum(x)) + offset


@host
def hosted(x):
    return summed(x)


class Thing:
    @property
    @public
    def setting(self):
        return jax.config.jax_numpy_rank_promotion

    @public
    def number(self, x):
        return float(x)


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_of_the_caller_stay_outside(name):
    inside = public(lambda: getattr(jax.config, name))
    outside = getattr(jax.config, name)
    with SETTINGS[name]():
        assert getattr(jax.config, name) not in (outside, inside())
        with own_settings():
            assert getattr(jax.config, name) == inside()
        chosen = getattr(jax.config, name)
        with pytest.raises(ZeroDivisionError):
            public(lambda: 1 // 0)()
        assert getattr(jax.config, name) == chosen  # after an error too
        assert inside() != chosen  # and the next call is as the first one
    assert getattr(jax.config, name) == outside


def test_settings_reach_methods_and_other_threads():
    with jax.numpy_rank_promotion("raise"):
        assert Thing().setting == "allow"
    before = jax.config.jax_numpy_rank_promotion
    jax.config.update("jax_numpy_rank_promotion", "raise")
    try:
        found = []
        thread = threading.Thread(target=lambda: found.append(Thing().setting))
        public(lambda: (thread.start(), thread.join()))()
        assert found == ["allow"] and jax.config.jax_numpy_rank_promotion == "raise"
    finally:
        jax.config.update("jax_numpy_rank_promotion", before)


def test_unchanged_settings_compile_nothing_again():
    """The contexts of the library are those of a caller who has set nothing."""
    traces = []

    @jax.jit
    def program(x):
        traces.append(1)
        return x + jnp.ones((2, 3))

    call = public(lambda: program(jnp.ones(3)))
    call()
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"), jax.transfer_guard("disallow"):
        call()
    assert len(traces) == 1


def test_arrays_of_other_libraries_become_numpy_arrays():
    points = np.arange(6.0).reshape(2, 3)
    found = values(
        Tensor(points),
        Tensor(points, elsewhere=True),
        scale=Tensor(2.0),
        others=[Tensor(points), 1],
        y=Table({"a": [1]}),
    )
    for one in (found["x"], *found["more"], found["scale"], found["others"][0], found["y"]):
        assert type(one) is np.ndarray
    np.testing.assert_array_equal(found["x"], points)
    assert found["scale"] == 2 and found["others"][1] == 1 and type(found["others"]) is list
    # What is known already is the same object.
    for same in (points, jnp.ones(2), [[1, 2]], (1.0,), "name", None, {"a": Tensor(1.0)}):
        assert values(same)["x"] is same


def test_columns_called_x_y_z_are_taken_in_this_order():
    columns = {"Z": [3.0, 6.0], "x": [1.0, 4.0], "y": [2.0, 5.0]}
    np.testing.assert_array_equal(plain_array("f()", "points", Table(columns)), [[1, 2, 3], [4, 5, 6]])
    for other in ({"b": [1.0], "a": [2.0]}, {"z": [1.0], "y": [2.0], "x": [3.0], "w": [4.0]}):
        np.testing.assert_array_equal(plain_array("f()", "points", Table(other)), np.stack(list(other.values()), 1))


def test_masked_numbers_are_refused_by_name():
    masked = np.ma.masked_greater(np.arange(6.0).reshape(2, 3), 4)
    with pytest.raises(InputError, match=r"^values\(\): 1 of the 6 numbers of x are masked; .*compress_rows\(x\)"):
        values(masked)
    with pytest.raises(InputError, match=r"^values\(\): 1 of the 3 numbers of scale are masked; .*Fill them"):
        values(1, scale=masked[1])
    whole = values(np.ma.masked_array([1.0, 2.0]))["x"]
    assert type(whole) is np.ndarray and whole.tolist() == [1, 2]


@pytest.mark.parametrize("call", [lambda: values(Broken()), lambda: values(1, x_2=0, others=[Broken()])])
def test_what_cannot_be_read_is_refused_by_name(call):
    with pytest.raises(
        InputError, match=r"^values\(\): (x|others) is a Broken that cannot be read as an array \(gone\)"
    ):
        call()


@pytest.mark.parametrize("transform", [jax.jit, jax.grad, jax.vmap])
def test_traced_numbers_are_refused_by_name(transform):
    x = jnp.ones(3) if transform is jax.vmap else jnp.float32(1)
    for function in (summed, hosted):
        with pytest.raises(InputError, match=rf"^{function.__name__}\(\): x is traced by jax.jit, .*Call it outside"):
            transform(lambda x, function=function: function(x) * x)(x)
    with pytest.raises(InputError, match=r"^Thing.number\(\): x is traced"):
        transform(lambda x: Thing().number(x) * x)(x)
    assert summed(np.ones(2)) == 2


def test_traced_parts_of_dataclasses_are_found_and_several_named():
    with pytest.raises(InputError, match=r"^summed\(\): x, offset are traced"):
        jax.jit(lambda x: public(summed.__wrapped__)(Holder([x]).points, offset=x))(1.0)

    def size(holder):
        return float(holder.points)

    with pytest.raises(InputError, match=r"size\(\): holder is traced"):
        jax.jit(lambda x: public(size)(Holder(x)))(1.0)


def test_known_numbers_inside_a_traced_function():
    inside = r"^{}\(\): it is called inside a function that jax.jit traces; .*pass its result in"
    with pytest.raises(InputError, match=inside.format("hosted")):
        jax.jit(lambda x: hosted(np.ones(3)) * x)(1.0)

    def computed():
        return float(jnp.ones(()))  # which is traced there

    with pytest.raises(InputError, match=r"computed\(\): it is called inside a function that jax.jit traces"):
        jax.jit(lambda x: public(computed)() * x)(1.0)
    assert jax.grad(lambda x: hosted(np.ones(3)) * x)(1.0) == 3
    np.testing.assert_array_equal(jax.vmap(lambda x: hosted(np.ones(3)) * x)(jnp.ones(2)), [3, 3])


def test_iterators_arrive_unread():
    assert list(host(lambda clouds: clouds)(iter([1, 2]))) == [1, 2]
    assert next(values(iter([3]))["x"]) == 3


def test_the_outermost_function_is_named():
    outer = public(lambda x: summed(x))
    with pytest.raises(InputError, match=r"<lambda>\(\): x is traced"):
        jax.jit(outer)(1.0)


def test_a_missing_platform_is_distinguished_from_other_errors(monkeypatch):
    def failing():
        raise RuntimeError("Unable to initialize backend 'cuda'")

    with pytest.raises(RuntimeError, match="Unable"):
        public(failing)()
    monkeypatch.setattr(boundary, "platform_problem", lambda: "JAX has no device of the platform 'cuda'")
    with pytest.raises(InputError, match=r"failing\(\): JAX has no device of the platform 'cuda'"):
        public(failing)()
