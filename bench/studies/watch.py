"""How often the live watch names an effect in clean bags of a pilot: the table in docs/live.md.

    python -m bench.studies.watch [--bags N] [--first SEED] [--seconds S] [--known]

The wrench's reading has a constant noise of 0.5 N and 0.04 to 0.08 N m. ``--known``: nothing is
estimated beside the coefficients, as in the cases of :mod:`hidden`; else what no file knows is
estimated, as by default. Exit status 1 if there is any false alarm.
"""

import argparse

import numpy as np

from bench.harness import Bars
from bench.simulators import hidden
from rov_ident.config import Config, from_parameters, to_parameters
from rov_ident.discrepancy.monitor import Monitor, Suspicion
from rov_ident.estimation.online import OnlineEstimator


def by_default(config: Config) -> Config:
    """The same with everything estimated that no vehicle's file knows."""
    document = to_parameters(config)
    for section, names in (
        ("vehicle", ("mass_std", "inertia_std", "buoyancy_std", "cog_std")),
        ("wrench", ("scale_std", "lag_std")),
        ("odometry", ("latency_std", "scale_std")),
    ):
        for name in names:
            document.get(section, {}).pop(name, None)
    document.pop("current_std", None)
    return from_parameters(document)


def said(seed: int, seconds: float, known: bool) -> list[Suspicion]:
    """All that the watch of a clean bag ever says."""
    moments = float(np.random.default_rng(seed).uniform(0.04, 0.08))
    conditions = hidden.Conditions(seconds, excitation="pilot", reading=(0.5, moments))
    case = hidden.draw(seed, conditions=conditions)
    online = OnlineEstimator(case.config if known else by_default(case.config), "rls")
    watch = Monitor(online.config)
    online.attach(watch)
    found, last = [], watch.suspicions
    for _, role, message in case.messages:
        online.push(role, message)
        if watch.suspicions is not last:
            last = watch.suspicions
            found += last
    return found


def main() -> int:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--bags", type=int, default=100)
    arguments.add_argument("--first", type=int, default=9100)
    arguments.add_argument("--seconds", type=float, default=180.0)
    arguments.add_argument("--known", action="store_true")
    given = arguments.parse_args()
    bars, alarms = Bars(), 0
    for count, seed in enumerate(range(given.first, given.first + given.bags), 1):
        found = said(seed, given.seconds, given.known)
        alarms += bool(found)
        names = ", ".join(dict.fromkeys(f"{s.effect} {s.axes}" for s in found))
        print(f"{seed}: {names or 'silent'} ({alarms} of {count})", flush=True)
    print(bars.check(alarms == 0, f"{alarms} of {given.bags}", "false alarms in clean bags"))
    return bars.status()


if __name__ == "__main__":
    raise SystemExit(main())
