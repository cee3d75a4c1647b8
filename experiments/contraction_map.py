"""Where d2 of Cao 2019 is exact, careful, or silent: a map of the plant's lag and of lam.

The plant is y(k+1) = a y(k) + (1 - a) u(k), static for a = 0. On each point CFDL-MFAILC learns a
step that was smoothed, and its contraction is observed: the largest |e_j| / |e_(j-1)| in norm over
the trials. Beside it stand d2 from the plant, the largest singular value of the frozen law's map of
errors. The start of the estimate is phi, so that nothing has to adapt, and d2 is the spectral
radius of that map.

The rows count the points by whether the bound is claimed, whether d2 and sigma_max are below 1, and
whether the error grew in some trial.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import output

import jaxilc
from jaxilc import Machine, Task, learn
from jaxilc.plants import DifferenceEquation
from jaxilc.schemes import CFDLMFAILC
from jaxilc.theory import BoundsWatch

N, TRIALS, POINTS = 60, 40, 24
TASK = Task(reference=0.5 - 0.5 * np.cos(np.pi * np.minimum(np.arange(N + 1) / 20, 1.0)), dt=1e-3)
LAWS = CFDLMFAILC(rho=1.0, eta=0.5, mu=1.0, reset="sign")
LAG, WEIGHT = np.linspace(0.0, 0.95, POINTS), np.geomspace(1e-3, 10.0, POINTS)


@jax.jit
def observed(a, lam):
    """The numbers of a `BoundsWatch` on one point, with those of the trials at their largest."""
    plant = DifferenceEquation(jnp.stack([a]), jnp.stack([1 - a]), dt=TASK.dt)
    scheme = dataclasses.replace(LAWS, lam=lam * (1 - a) ** 2, phi0=1 - a)
    found = learn(Machine(plant), scheme, TASK, TRIALS, watch=BoundsWatch(sigma_steps=N)).watched
    return {name: jnp.nanmax(value) for name, value in found.items()} | {
        "kept": jnp.nanmin(found["share_kept"])
    }


def main() -> None:
    jaxilc.setup()
    folder = output.folder(__file__)
    a, lam = np.meshgrid(LAG, WEIGHT)
    over = jax.jit(lambda points: jax.lax.map(lambda p: observed(*p), points, batch_size=16))
    flat = over((jnp.asarray(a.ravel()), jnp.asarray(lam.ravel())))
    found = {name: np.asarray(value).reshape(a.shape) for name, value in flat.items()}
    claimed, grew = found["claimed"] == 1, found["contraction_norm"] > 1 + 1e-9
    assert np.all(found["kept"][claimed] == 1), "a bound that was claimed did not hold"
    rows = []
    for name, where in {
        "claimed": claimed,
        "d2 < 1, not claimed": (found["d2"] < 1) & ~claimed,
        "d2 < 1, sigma_max > 1": (found["d2"] < 1) & (found["sigma_max"] > 1),
        "sigma_max < 1": found["sigma_max"] < 1,
        "all": np.ones_like(claimed),
    }.items():
        rows.append({"points": name, "number": int(where.sum()), "grew": int(grew[where].sum())})
    output.write_rows(folder / "points.csv", rows)
    axes = output.axes()
    colour = np.clip(np.log10(found["contraction_norm"]), -1, 1)
    mesh = axes.pcolormesh(LAG, WEIGHT, colour, cmap="coolwarm", vmin=-1, vmax=1)
    axes.figure.colorbar(mesh, label="log10 of the largest contraction observed")
    for name, levels, style in (("d2", [0.1, 0.5, 0.9], "-"), ("sigma_max", [1.0], "--")):
        lines = axes.contour(
            LAG, WEIGHT, found[name], levels=levels, linestyles=style, colors="black"
        )
        axes.clabel(lines, fmt=lambda level, name=name: f"{name} = {level:g}", fontsize=8)
    axes.plot(a[claimed], lam[claimed], "k.", markersize=2, label="d2 claimed")
    axes.set(yscale="log", xlabel="lag a", ylabel="lam / (1 - a)^2", title="Contraction")
    axes.legend(loc="lower left")
    axes.figure.savefig(folder / "map.png")


if __name__ == "__main__":
    main()
