"""Small parts of experiments that attack, and that they see what is wrong."""

import claims_under_attack as attack
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import steps_under_attack as steps
from cases import SCHEMES

from jaxilc.theory.certificates import DIVERGES, MONOTONE, long_run


@pytest.mark.thorough(but=["on_basis"])
@pytest.mark.parametrize("name", ["p_type_fir", "on_basis"])
def test_what_is_claimed_is_what_numpy_and_the_simulation_do(name):
    row, wrong = attack.of_scheme(name, rounds=1, count=12, seed=1)
    assert row["claimed"] >= 4
    assert not wrong


@pytest.mark.thorough
def test_the_attack_sees_a_wrong_claim():
    """A claim that is made stronger than it is, is contradicted."""
    rng = np.random.default_rng(3)
    machines, task = attack.machines_of(rng, "p_type_fir", 24, False, None)
    machines, scheme = jax.tree.map(jnp.asarray, machines), SCHEMES["p_type_fir"]
    found = long_run(machines, scheme, task)
    e, d = attack.run_plain("p_type_fir", machines, scheme, task)

    def seen(found, i):
        return attack.contradicted(found, i, e[i], d[i], [1.0, e[i][0]])

    at = {claim: np.flatnonzero(found.claim == claim) for claim in (MONOTONE, DIVERGES)}
    assert all(map(len, at.values()))
    assert not any(seen(found, i) for some in at.values() for i in some)
    stronger = found._replace(sigma=0.5 * found.sigma)
    assert any(seen(stronger, i) for i in at[MONOTONE])
    swapped = found._replace(claim=np.where(found.claim == DIVERGES, MONOTONE, DIVERGES))
    assert all(seen(swapped._replace(sigma=np.full(24, 0.99)), i) for i in at[DIVERGES])
    assert all(seen(swapped, i) == attack.LATE for i in at[MONOTONE])
    lower = found._replace(outlook=found.outlook._replace(floor=0.5 * found.outlook.floor))
    assert any("floor" in seen(lower, i) for i in at[MONOTONE])


def test_rounding_at_random_leads_as_far_as_a_fourier_transform_in_single_precision():
    """Without the errors within the transform it led to less than what is seen."""
    x = np.random.default_rng(4).standard_normal((50, 256)).astype(np.float32)
    exact = np.fft.rfft(x.astype(float))
    with jax.enable_x64(False):
        single = np.asarray(jnp.fft.rfft(jnp.asarray(x)))
    drawn = steps.rounded_at_random(jnp.fft.rfft, jnp.uint64(5), jnp.asarray(x.astype(float)))
    seen, told = (np.linalg.norm(y - exact) for y in (single, np.asarray(drawn)))
    assert seen < told < 4 * seen
