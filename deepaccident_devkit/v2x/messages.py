"""What each agent contributes at a moment, after the link between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AgentName
from deepaccident_devkit.v2x.configurations import Agents, cooperating_agents
from deepaccident_devkit.v2x.link import Link, checked_link


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Message:
    """One agent's data as the ego receives them.

    Attributes:
        agent: the agent that sent them.
        sample: token of the sample of the data: with latency an earlier one.
        pose_error: `claimed_from_world`; None without pose noise.
    """

    agent: AgentName
    sample: str
    pose_error: SE3 | None

    def target_from(self, dataset: Dataset, frame: str, target_from_world: SE3) -> SE3:
        """Where the ego places coordinates of the sender's `frame`: `target_from_frame`, pose noise included."""
        world_from_frame = dataset.world_from(self.sample, frame)
        if self.pose_error is not None:
            world_from_frame = self.pose_error @ world_from_frame
        return target_from_world @ world_from_frame


def messages(
    dataset: Dataset, sample: RowArgument, agents: Agents = None, link: Link | None = None, *, sweeps: int = 1
) -> Iterator[Message]:
    """What the agents contribute at a sample and at the frames before it, the sample's own agent first.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: who cooperates (`cooperating_agents`).
        link: what happens to the partners' data; None for nothing.
        sweeps: number of frames, the present included; those before the recording began are left out.

    Yields:
        By frame, the present first and then backwards, and for each frame by agent; nothing for a lost message.

    Raises:
        TokenError, ChoiceError, NotAvailableError: as in `cooperating_agents`.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past at the present.
    """
    link = checked_link(link)
    names = cooperating_agents(dataset, sample, agents)
    scenario, ego, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    for index in range(int(number), max(int(number) - sweeps, 0), -1):
        for agent in names:
            if link is None or agent == ego:
                yield Message(agent=agent, sample=sample_token(scenario, agent, index), pose_error=None)
            elif index == int(number) or index > link.latency_frames:
                message = _received(dataset, scenario, agent, index, link)
                if message is not None:
                    yield message


def _received(dataset: Dataset, scenario: str, agent: AgentName, index: int, link: Link) -> Message | None:
    sent = sample_token(scenario, agent, link.frame_sent(scenario, index))
    if link.loses(scenario, agent, index):
        return None
    error = None
    if link.pose_noise is not None:
        error = link.pose_error(scenario, agent, index, dataset.world_from(sent, "ego").translation)
    return Message(agent=agent, sample=sent, pose_error=error)
