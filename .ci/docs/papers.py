"""A page for each paper: its equations, how it is read, its numbers and conclusions beside ours.

Everything but the equations is what `jaxilc reproduce` finds and draws.
"""

from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

from jaxilc.figures.published import options_of

EQUATIONS = {  # by scenario: what is computed, and the equations of the paper
    "cao-2019": (
        ("the estimate of the pseudo partial derivative (eq. 13) and the law (eq. 12)",
         r"\hat\varphi_j(k) = \hat\varphi_{j-1}(k) + \frac{\eta \, \Delta u_{j-1}(k)}"
         r"{\mu + \Delta u_{j-1}(k)^2} \left(\Delta y_{j-1}(k+1) - \hat\varphi_{j-1}(k) \,"
         r" \Delta u_{j-1}(k)\right)"),
        ("",
         r"u_j(k) = u_{j-1}(k) + \frac{\rho \, \hat\varphi_j(k)}{\lambda + \hat\varphi_j(k)^2}"
         r" \, e_{j-1}(k+1)"),
    ),
    "cao-2019-rig": (
        ("the same law, on a machine with friction; two steps of it from u = 0 within a sample are",
         r"u(k) = 2 \, \frac{\rho \, \varphi}{\lambda + \varphi^2} \, e(k)"),
    ),
    "dai-2014": (
        ("the first move over a horizon of P samples with one control move (eq. 10)",
         r"\Delta u(k) = \frac{\hat\varphi(k) \, \frac 1P \sum_{i=1}^{P}"
         r" \left(y^*(k+i) - y(k)\right)}{\hat\varphi(k)^2 + \lambda / P}"),
    ),
    "li-2020": (
        ("learning beside feedback (eq. 2), and where it is monotone (eq. 9)",
         r"u_j = w_j + C e_j, \qquad w_j = w_{j-1} + \phi \, e_{j-1}"),
        ("", r"\left| 1 - \frac{\phi z G}{1 + C G} \right| < 1"),
    ),
    "milc-2024": (
        ("the cost of the next trial (eq. 5), of DILC with the input u, of MILC with u and r",
         r"J = |e_{j+1}|^2_{W_q} + |u_{j+1} - u_j|^2_{W_r} + |u_{j+1}|^2_{W_s}"),
        ("Theorem 2: on the model learning is monotone, since",
         r"|M| = |(H' W_q H + W_s + W_r)^{-1} W_r| < 1"),
    ),
    "xu-2024": (
        ("the sliding surface, and learning with an exponential gain (eq. 27)",
         r"\sigma = \dot e + \lambda_1 e + \lambda_2 \int e \, dt, \qquad u_{j+1} = u_j +"
         r" e^{\lambda_0 t} (K_P e_j + K_D \dot e_j)"),
        ("the condition (eq. 36)",
         r"\left| 1 - \frac{(K_P + s K_D) \, e^{\lambda_0 t}}"
         r"{s (s + \lambda_1 + \lambda_2 / s)} \right| < 1"),
    ),
}  # fmt: skip


def write(folder: Path) -> list[str]:
    """Write the pages, each with its picture; return their names."""
    import numpy as np

    import jaxilc
    from jaxilc import outcomes, scenarios

    jaxilc.setup()
    found = outcomes.reproduce(list(EQUATIONS))
    (folder / "papers").mkdir()
    names = []
    for name, of_rows in groupby(found.numbers["rows"], key=lambda row: row["scenario"]):
        print(f"paper {name}", flush=True)
        scenario, picture = scenarios.load(name), folder / "papers" / f"{name}.png"
        np.ravel(found.figures[name].draw())[0].figure.savefig(picture, dpi=90)
        concluded = [one for one in found.numbers["conclusions"] if one["scenario"] == name]
        text = _page(scenario, list(of_rows), concluded)
        (folder / "papers" / f"{name}.md").write_text(text, encoding="utf-8")
        names.append(f"papers/{name}")
    return names


def _page(scenario: Any, rows: list[dict], concluded: list[dict]) -> str:
    """The text of a page."""
    parts = [f"# {scenario.title}\n", *_equations(scenario.name), "## How it is read\n"]
    reading = scenario.options.get("reading")
    parts += [f"Reading: `{reading}`.\n"] if reading else []
    parts += ["\n".join(f"- {text}" for text in scenario.chosen) + "\n", "## Numbers\n"]
    parts.append(
        f"![The printed numbers and ours, row by row]({scenario.name}.png)\n\n"
        "In the dark band a number is met, in the pale one it is in the printed order. Numbers to "
        "which something was fitted are in italics; what repeats or derives from another one is "
        "not counted.\n"
    )
    head = ("place", "printed words", "scheme", "trial", "quantity", "printed", "ours", "verdict")
    cells = [_cells(row) for row in rows]
    alike = [False, *(one[:3] == other[:3] for one, other in pairwise(cells))]
    shown = [("", "", *of[2:]) if same else of for of, same in zip(cells, alike, strict=True)]
    parts.append(_table(head, shown))
    told = [
        (c["source"], f'{c["says"]} ("{c["words"]}")', _sides(c), _verdict(c)) for c in concluded
    ]
    parts += ["## Conclusions\n", _table(("place", "it concludes", "ours", "verdict"), told)]
    parts.append(f"`jaxilc reproduce {scenario.name} --details` prints this.\n")
    return "\n".join(parts)


def _equations(name: str) -> list[str]:
    lines = []
    for said, equation in EQUATIONS[name]:
        lines += [f"{said[0].upper()}{said[1:]}:\n"] if said else []
        lines.append(f"$$ {equation} $$\n")
    return lines


def _cells(row: dict) -> tuple[str, ...]:
    kind = "" if row["kind"] == "number" else f" ({row['kind']})"
    fitted = " *fitted*" if row["among_fitted"] else ""
    return (
        row["source"],
        row["words"],
        row["scheme"] + (f" against {row['against']}" if row["against"] else ""),
        f"{row['trial'] or ''}",
        row["quantity"].replace("_", " ") + options_of(row),
        f"{'< ' * row['at_most']}{row['value']:g} {row['unit']}{kind}",
        f"{row['ours']:.3g}",
        f"{row['verdict']}{fitted}" + (f": {row['reason']}" if row["reason"] else ""),
    )


def _sides(one: dict) -> str:
    """What was simulated for each side of a conclusion, with our number."""
    sides = (
        f"{x:.3g} {one['unit']}".rstrip() + ("" if isinstance(side, float) else f" ({side})")
        for side, x in zip(one["sides"], one["ours"], strict=True)
    )
    return "; ".join(sides)


def _verdict(one: dict) -> str:
    return "holds" if one["holds"] else "does not hold"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(c.replace('|', '/') for c in row)} |" for row in lines) + "\n"
