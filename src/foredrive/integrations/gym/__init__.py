"""Gymnasium environments of the towns; the import registers them. Needs the extra `gym`.

    gymnasium.make("foredrive.integrations.gym:foredrive/Town05-v0")

There is one for each town that is built whole, but for those of the routes that nobody looks at.
"""

from gymnasium.envs.registration import register

from foredrive.towns.map.names import TOWNS, UNSEEN_TOWNS

for _town in TOWNS:
    if _town not in UNSEEN_TOWNS:
        register(
            id=f"foredrive/{_town}-v0",
            entry_point="foredrive.integrations.gym.town_env:TownEnv",
            kwargs={"town": _town},
        )
