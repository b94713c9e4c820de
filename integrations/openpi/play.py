"""openpi's own client plays the toy with a policy that madviz serves.

madviz serve --policy madviz.examples.own_policy:make --port 8000    # madviz's environment
.venv/bin/python play.py --port 8000 --episodes 5                    # that of setup.sh
"""

from __future__ import annotations

import argparse

import gymnasium
from openpi_client.websocket_client_policy import WebsocketClientPolicy

import madviz  # noqa: F401 - It tells Gymnasium of its tasks.


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--task", default="reach-v0")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--drop", nargs="*", default=[], help="cameras that are not sent")
    asked = parser.parse_args()
    policy = WebsocketClientPolicy("127.0.0.1", asked.port)
    print("served:", policy.get_server_metadata()["madviz"]["name"])
    env = gymnasium.make(f"madviz/{asked.task}", depth=False)
    successes = 0
    for seed in range(asked.seed, asked.seed + asked.episodes):
        seen, info = env.reset(seed=seed)
        over = False
        while not over:
            sent = {name: each for name, each in seen["pixels"].items() if name not in asked.drop}
            sent |= {"state": seen["agent_pos"], "prompt": "", "episode": seed}
            answer = policy.infer(sent)
            seen, _, terminated, truncated, info = env.step(answer["actions"][0])
            over = terminated or truncated
        successes += info["is_success"]
    print(f"{successes} of {asked.episodes} successful")


if __name__ == "__main__":
    main()
