"""One uninterrupted run: its channels, its events and what does not change meanwhile."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from palpate.errors import PalpateError
from palpate.recordings.channel import Channel, Events
from palpate.recordings.facts import Fact


@dataclass(frozen=True, eq=False)
class Trial:
    """One uninterrupted run: `channels` and `events` by name on one clock, and static `facts`."""

    name: str
    channels: Mapping[str, Channel]
    events: Mapping[str, Events] = field(default_factory=dict)
    facts: Mapping[str, Fact] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.channels:
            raise PalpateError(f"trial '{self.name}' has no channels")
        if both := self.channels.keys() & self.events.keys():
            raise PalpateError(
                f"trial '{self.name}' has a channel and events called '{min(both)}': "
                "expected a name for each"
            )
        for key, channel in (*self.channels.items(), *self.events.items()):
            if key != channel.name:
                raise PalpateError(
                    f"trial '{self.name}' lists channel '{channel.name}' under the name '{key}'"
                )
        for name in ("channels", "events", "facts"):
            object.__setattr__(self, name, dict(getattr(self, name)))

    def __getitem__(self, name: str) -> Channel:
        """The channel called `name`; raises `PalpateError` that lists those there are."""
        if name in self.events:
            raise PalpateError(
                f"'{name}' of trial '{self.name}' holds events, which are never interpolated: "
                "name it in events=, which finds the newest for each frame"
            )
        if name not in self.channels:
            there = ", ".join(self.channels)
            raise PalpateError(f"trial '{self.name}' has no channel '{name}'; it has: {there}")
        return self.channels[name]

    def event(self, name: str) -> Events:
        """The events called `name`; raises `PalpateError` that lists those there are."""
        if name not in self.events:
            there = ", ".join(self.events) or "none"
            raise PalpateError(f"trial '{self.name}' has no events '{name}'; it has: {there}")
        return self.events[name]

    @property
    def parts(self) -> tuple[Channel | Events, ...]:
        """All channels, sampled ones first."""
        return *self.channels.values(), *self.events.values()

    @property
    def start(self) -> float:
        """The first stamp of any channel, s."""
        return float(min(part.time[0] for part in self.parts))

    @property
    def duration(self) -> float:
        """Seconds from the first stamp of any channel to the last of any."""
        return float(max(part.time[-1] for part in self.parts)) - self.start
