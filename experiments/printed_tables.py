"""The printed tables of the papers as dictionaries, for the experiments that compare with them."""

from collections.abc import Iterable

from jaxilc.pytree.aliases import Tree
from jaxilc.scenarios.published import Published, published


def by(rows: Iterable[Published], *keys: str, **where: object) -> Tree:
    """The values of rows by one or several keys, nested: {scheme: {trial: value}}.

    keys: names of fields or of options
    where: values of fields that rows must have
    """
    found: Tree = {}
    for row in rows:
        if all(getattr(row, name) == value for name, value in where.items()):
            known = row._asdict() | dict(row.options)
            inner = found
            for key in keys[:-1]:
                inner = inner.setdefault(known[key], {})
            inner[known[keys[-1]]] = row.value
    return found


# settled errors [µm]: Table 1, and what section IV-D adds to its column of ILC-MFAPC
_CAO = [row for row in published("cao-2019", "stroke") if row.source in ("Table 1", "section IV-D")]
CAO_1 = by(_CAO, "scheme", "trial")
CAO_2 = by(published("cao-2019-rig", "over-trials"), "scheme", "frequency")  # by frequency [µm]
_MILC = published("milc-2024", "short-stroke")
MILC_1 = {(p.scheme, p.trial, p.quantity): p.value for p in _MILC if not p.against}  # [µm]
IMPROVEMENT = by(_MILC, "scheme", against="dilc")["milc"]  # of the table's largest error [%]
LI = by(published("li-2020"), "setting", "scheme", "quantity", "trial")  # errors [µm]
XU_1, XU_2 = (  # largest and RMS error by scheme [nm]
    {
        scheme: tuple(errors.values())
        for scheme, errors in by(
            published("xu-2024", "large-gain"), "scheme", "quantity", source=f"Table {i}"
        ).items()
    }
    for i in (1, 2)
)
