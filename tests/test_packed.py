"""Arrays of a loop put together, and the settings of the compiler."""

import gc
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxekf
from jaxekf.filtering.lowering.packed import pack


def test_a_scan_over_packed_arrays_is_the_scan():
    """An array put back at another's place or shape, a type that changes, a scalar lost."""
    steps = {
        "mask": jnp.arange(12).reshape(4, 3) % 2 == 0,
        "number": jnp.arange(4.0),
        "matrix": jnp.arange(48.0).reshape(4, 2, 3, 2),
        "flag": jnp.array([True, False, True, True]),
    }

    def plain(total, at):
        total = total + jnp.where(at["flag"], at["number"], 0.0) * at["matrix"][0, 1, 1]
        return total, {"total": total, "turned": at["matrix"].swapaxes(0, 1), "mask": at["mask"]}

    def put_together(total, at):
        total, found = plain(total, at.unpack())
        return total, pack(found)

    wanted = lax.scan(plain, 0.0, steps)
    total, found = lax.scan(put_together, 0.0, pack(steps, 1))
    np.testing.assert_array_equal(total, wanted[0])
    for a, b in zip(jax.tree.leaves(found.unpack()), jax.tree.leaves(wanted[1]), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert len(jax.tree.leaves(pack(steps, 1))) == 2


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (None, "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling"),
        (
            "--xla_dump_to=x",
            "--xla_dump_to=x --xla_backend_extra_options=xla_cpu_disable_loop_unrolling",
        ),
        ("--xla_backend_extra_options=xla_none", "--xla_backend_extra_options=xla_none"),
    ],
)
def test_set_up_adds_to_the_flags(monkeypatch, before, after):
    """A user's own flags lost or overruled, or the compiler's option said twice."""
    if before is None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    else:
        monkeypatch.setenv("XLA_FLAGS", before)
    for _ in range(2):
        jaxekf.set_up()
        assert os.environ["XLA_FLAGS"] == after


@pytest.mark.parametrize(("before", "after"), [(700, 50_000), (90_000, 90_000), (0, 0)])
def test_set_up_leaves_a_collector_that_looks_seldom(before, after):
    """A collector that its user switched off, or set to look less often still, made to look again."""
    usual = gc.get_threshold()
    try:
        gc.set_threshold(before, 10, 10)
        jaxekf.set_up()
        assert gc.get_threshold()[0] == after
    finally:
        gc.set_threshold(*usual)
