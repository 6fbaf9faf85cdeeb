"""The agent file for CARLA's leaderboards and Bench2Drive: `--agent carla_agent.py --agent-config RUN`.

RUN is an agent as `foredrive drive --agent` knows it: a run folder, embedded:nemo_town, stop, …
"""

from foredrive.runs.drive.leaderboard_agent import ForedriveAgent, get_entry_point

__all__ = ["ForedriveAgent", "get_entry_point"]
