"""Which messages are refused, and why: fields, frames and stamps; each refusal is counted by name.

Bad data never raises. Whatever is refused leaves everything as it was.
"""

import math
from collections import Counter
from collections.abc import Mapping

from rov_ident.core.messages import ODOMETRY, Joints, Message, Odometry, fault

NEW_CLOCK = "clock: jumps, buffers restarted"
"""Counted where stamps restart: a bag that starts over, another computer."""
AHEAD = "clock: stepped ahead, or all topics silent, buffers restarted"
"""Counted where stamps go on far ahead of those of all topics, as they do after a pause of all."""
NEW_FRAME = "frame: another has the majority, buffers restarted"
"""Counted where a topic continues in another frame."""
NO_ODOMETRY, NO_WRENCH = "sample: no odometry yet", "sample: no wrench"
"""Counted where a topic has not begun, or not again."""
RESTARTS = (NEW_CLOCK, AHEAD, NEW_FRAME)
REPEATED = 2e3
"""The variance that marks a velocity as not measured again; drivers use 1e3 and more for that."""

_LARGEST_JUMP = 10.0  # s; a stamp this far ahead of the stamps of all topics, or ...
_LARGEST_STEP_BACK = 1.0  # s behind that of its own, may be of another clock: topics that are
# reordered, or lost for a while together, stay well within both
_AGREEMENT = 1.0  # s; two stamps out of line that are so close to one another are of one new clock
CLOCK_STEP = 0.1  # s; ntpd steps clocks by 0.128 s and more, systemd by 0.4 s, and slews by less
_MOST_VOTES = 1000  # messages, some seconds: as long another frame id is refused, at most
_REASONS = 100  # so many names of refusals are kept, so that a log cannot be flooded with them
_GRID = 1e-4  # m/s; drivers that round velocities round to no finer grid than this
_OFF_GRID = 0.01  # of a grid step; single precision of 10 m/s is that near
_FINE_MESSAGES = 20  # a velocity off the grid shows for so many messages that they are not rounded
_WORLD_FRAMES = ("map", "odom", "world", "earth", "world_ned", "map_ned", "odom_ned")


class Validation:
    """Judges messages as they are on the wire, one after another.

    ``counts`` holds, by name, how many were refused; the sampler adds those that were taken.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._frame_ids: dict[str, tuple[str, ...]] = {}  # by topic, those of most of its messages
        self._votes: Counter[str] = Counter()  # by topic, for them less those against them
        self._other_frames: dict[str, tuple[str, ...]] = {}  # by topic, those last refused
        self._last_stamp: dict[str, int] = {}  # ns
        self._suspect: dict[str, int] = {}  # ns; a stamp out of line, by topic
        self.forget_motion()

    def forget_motion(self) -> None:
        """Compare the next velocity with none before it."""
        self._velocity = b""  # bytes of the last one
        self._fine = 0  # messages for which velocities still count as not rounded to a grid

    def forget_frames(self) -> None:
        """Have the next message of each topic decide in which frame it is."""
        self._votes.clear()

    def frame_id(self, role: str) -> str:
        """In which a topic's vectors are; empty before its first message."""
        return self._frame_ids.get(role, ("",))[-1]

    @property
    def stamps(self) -> Mapping[str, int]:
        """The stamp [ns] of the last message that was taken of each topic."""
        return self._last_stamp

    def judge(self, role: str, message: Message) -> str:
        """Why a message is refused, after counting it; empty if it is taken.

        One of :data:`RESTARTS` if it is the first to be taken of another clock, or in other frames.
        """
        reason = self._fault(role, message) or self._stamp_fault(role, message.stamp)
        if not reason:
            self._last_stamp[role] = message.stamp
            self._suspect.pop(role, None)
        elif reason in RESTARTS:
            self.counts[reason] += 1
            self._last_stamp = {role: message.stamp}
        else:
            name = f"{role}: {reason}"
            if name not in self.counts and len(self.counts) >= _REASONS:
                name = f"{role}: refused for yet another reason"
            self.counts[name] += 1
        return reason

    def _fault(self, role: str, message: Message) -> str:
        """What is wrong with the fields or the frame, or an empty string."""
        if wrong := fault(message):
            return wrong
        if isinstance(message, Joints):
            return ""
        frames: tuple[str, ...] = (message.frame_id,)
        if isinstance(message, Odometry):
            frames = (message.frame_id, message.child_frame_id)
        held = self._frame_ids.get(role)
        if held == frames:
            self._votes[role] = min(self._votes[role] + 1, _MOST_VOTES)
            return ""
        if frames[-1].rsplit("/", 1)[-1] in _WORLD_FRAMES:
            return f"frame {_printable(frames[-1:])} is a world frame, body axes are needed"
        # Boyer and Moore's vote: what most of the messages say is held, whichever came first. Two
        # in a row must agree: a frame that is another each time takes nothing over.
        suspect, self._other_frames[role] = self._other_frames.get(role), frames
        if held is None or (self._votes[role] == 0 and suspect == frames):
            self._frame_ids[role], self._votes[role] = frames, 1
            return "" if held is None else NEW_FRAME
        self._votes[role] = max(self._votes[role] - 1, 0)
        return f"frame changed from {_printable(held)} to {_printable(frames)}"

    def _stamp_fault(self, role: str, stamp: int) -> str:
        """What is wrong with the stamp [ns] after the last one of its topic, or an empty string."""
        last = self._last_stamp.get(role)
        if last is None:
            return ""
        step = (stamp - last) * 1e-9
        # a topic that goes on where the others are has only been silent
        ahead = (stamp - max(self._last_stamp.values())) * 1e-9
        if step > 0.0 and ahead <= _LARGEST_JUMP:
            if role == ODOMETRY and step > _LARGEST_JUMP:
                self.forget_motion()
            return ""
        # A single wild stamp is an error. Two in a row that agree are of another clock, and so are
        # two that are both late, the second shortly after the first; reordering makes single ones.
        suspect = self._suspect.get(role)
        self._suspect[role] = stamp
        since = math.inf if suspect is None else (stamp - suspect) * 1e-9
        if -_LARGEST_STEP_BACK <= step <= 0.0:
            if step < -CLOCK_STEP and 0.0 < since < CLOCK_STEP:
                return NEW_CLOCK
            return "duplicate stamp" if step == 0.0 else "backward stamp"
        if abs(since) >= _AGREEMENT:
            return "stamp jumps"
        return AHEAD if step > 0.0 else NEW_CLOCK

    def marked(self, message: Odometry) -> Odometry:
        """The message, its velocity marked by its variance if it has not been measured again.

        That is so if it repeats the last one to the last digit: its sensor has lost the ground, or
        is slower than its messages. Where velocities are rounded to a grid it may be by chance.
        """
        velocity, before = message.linear.tobytes(), self._velocity
        self._velocity = velocity
        if velocity == before:
            if self._fine:
                variance = message.twist_variance.copy()
                variance[:3] = REPEATED
                return message._replace(twist_variance=variance)
        else:
            steps = [v / _GRID for v in message.linear.tolist()]
            off = any(abs(step - round(step)) > _OFF_GRID for step in steps)
            self._fine = _FINE_MESSAGES if off else max(self._fine - 1, 0)
        return message


def _printable(frames: tuple[str, ...]) -> str:
    """Frame ids as they may stand in a log, whatever is in them."""
    return ", ".join(repr(frame if len(frame) <= 40 else f"{frame[:37]}...") for frame in frames)


def describe(counts: Mapping[str, int]) -> list[str]:
    """The refusals among a sampler's counts, in words, most frequent first."""
    refused = {name: n for name, n in counts.items() if ":" in name and n}
    return [f"{name} ({n})" for name, n in sorted(refused.items(), key=lambda item: -item[1])]
