"""What the clocks of wrench, odometry and IMU do to each other, and what is not sure beside it.

A delay of thrust moves the motion behind the wrench. No cause moves it ahead: then stamps are
wrong, and any effect that looks like earlier thrust (the forces of added mass do) is made of that.
And a late attitude is behind the thrust like late thrust, but behind the gyro, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from rov_ident.config import Config
from rov_ident.discrepancy.findings import unsure
from rov_ident.discrepancy.results import Finding
from rov_ident.effects import EFFECTS
from rov_ident.offline import delays
from rov_ident.sampling.raw_streams import Streams

_STAMPS = "wrong stamps may have made it"


@dataclass(frozen=True)
class ClockErrors:
    """The longest times [s] by which the motion is ahead of the wrench, and the odometry's attitude
    and rates behind the gyro; zero where they surely are not."""

    ahead: float
    behind: float

    @property
    def notes(self) -> list[str]:
        """What is wrong, in words."""
        told = []
        if self.ahead:
            told.append(f"{delays.ahead_of_wrench(self.ahead)}; no cause is sure beside that")
        if self.behind:
            told.append(f"{delays.behind_imu(self.behind)}; whether thrust is late is not sure")
        return told

    def beside(self, found: Finding) -> Finding:
        """The finding, not sure where wrong stamps may have made it."""
        made = self.ahead and not EFFECTS[found.effect].of_sensors
        late = self.behind and "late" in EFFECTS[found.effect].traits
        return unsure(found, _STAMPS) if made or late else found


def of(bags: Sequence[Streams], config: Config) -> ClockErrors:
    """The errors of the clocks of some bags, the worst of each kind."""
    tests = [test for bag in bags for test in delays.tests_of(bag, config, late=True)]
    return ClockErrors(
        max((test.value for test in tests if not test.passed), default=0.0),
        max(delays.surely_behind_imu(bag, config) for bag in bags),
    )
