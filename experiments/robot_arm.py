"""The flexible robot arm of the DaISy collection beside an output-error fit written by hand.

The record is not ours to give away: `JAXILC_MEASURED` names its folder, without which the
experiment says so and ends. The input is the torque on the ground, the output the acceleration of
the arm; the first 70 % are fitted, and the rest judges. The peer shares no code with the package:

    y = B(z) / F(z) u + constant,    F stable, both of the same degree, from many starts

The peer lets an output answer the input of its own sample, as an acceleration does. A plant of the
package answers one sample later, after the hold, so it needs a pole or two more. It also fits the
motion in which the record begins, the end of a periodic sweep; the peer begins at rest.
"""

import time

import numpy as np
import scipy.optimize
import scipy.signal
from output import folder, measured_folder, write_rows

import jaxilc
from jaxilc.identification import grow, read_record

ORDERS, STARTS, SHARE = (4, 5, 6, 8), 20, 0.7


def fit(y, simulated):
    return 100 * float(1 - np.linalg.norm(y - simulated) / np.linalg.norm(y - np.mean(y)))


def simulated_by_poles(x, u, y, fitted):
    """The output of the poles in `x` with the least squares of B over the fitted part."""
    a, of_poles = np.zeros(0), np.ones(1)
    for i in range(0, len(x) - len(x) % 2, 2):  # a stable section: |a_2| < 1, |a_1| < 1 + a_2
        a_2 = np.tanh(x[i])
        of_poles = np.convolve(of_poles, [1.0, (1 + a_2) * np.tanh(x[i + 1]), a_2])
    if len(x) % 2:
        of_poles = np.convolve(of_poles, [1.0, np.tanh(x[-1])])
    a = scipy.signal.lfilter([1.0], of_poles, u)
    late = [np.concatenate([np.zeros(k), a[: len(a) - k]]) for k in range(len(x) + 1)]
    A = np.column_stack([*late, np.ones(len(u))])
    return A @ np.linalg.lstsq(A[:fitted], y[:fitted])[0]


def by_hand(u, y, fitted, order, rng):
    """The output of the best of the starts on the fitted part."""
    found = []
    for _ in range(STARTS):
        start = rng.normal(size=order)
        start[::2] += 1.5
        result = scipy.optimize.least_squares(
            lambda x: (simulated_by_poles(x, u, y, fitted) - y)[:fitted], start, max_nfev=200
        )
        found.append((result.cost, result.x))
    return simulated_by_poles(min(found, key=lambda one: one[0])[1], u, y, fitted)


def main() -> None:
    place = measured_folder()
    if place is None:
        return
    jaxilc.setup()
    record = read_record(place / "robot_arm.csv")
    u, y = np.asarray(record.u)[:, 0], np.asarray(record.y)[:, 0]
    u = np.append(u, u[-1])[: len(y)]
    fitted, rng, rows = round(SHARE * len(y)), np.random.default_rng(0), []
    for order in (*ORDERS, None):
        if order:
            by = by_hand(u, y, fitted, order, rng)
            rows.append(
                {"by": "hand", "order": order, "fitted_percent": fit(y[:fitted], by[:fitted]),
                 "judged_percent": fit(y[fitted:], by[fitted:]), "white": "", "processor_s": ""}
            )  # fmt: skip
        began = time.process_time()
        model = grow(record, order=order)
        ours = np.asarray(model.found.simulated)[:, 0]
        rows.append(
            {"by": "grow" if order else "grow, order found", "order": model.chosen.order,
             "fitted_percent": fit(y[:fitted], ours[:fitted]),
             "judged_percent": fit(y[fitted:], ours[fitted:]), "white": model.found.white,
             "processor_s": time.process_time() - began}
        )  # fmt: skip
    write_rows(folder(__file__) / "robot_arm.csv", rows)


if __name__ == "__main__":
    main()
