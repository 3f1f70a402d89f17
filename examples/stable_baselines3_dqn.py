"""Train DQN of Stable-Baselines3 to balance the pole, and show the score that it reaches.

python examples/stable_baselines3_dqn.py --steps 50000 --show

It needs `pip install stable-baselines3`. The best possible score of an episode is 500.
"""

import argparse

import gymnasium
from stable_baselines3 import DQN
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import cartpole_rl  # noqa: F401 - registers the environments


def main() -> None:
    """Train, then judge the greedy policy on ten episodes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--env", default="cartpole_rl/Balance-v0")
    parser.add_argument("--steps", type=int, default=50_000, help="control periods of 20 ms to train for")
    parser.add_argument("--episodes", type=int, default=10, help="to judge the policy by")
    parser.add_argument("--show", action="store_true", help="show the judged episodes in a window")
    options = parser.parse_args()

    env = gymnasium.make(options.env)
    agent = DQN("MlpPolicy", env, learning_rate=1e-3, learning_starts=500, train_freq=1, seed=0, verbose=1)
    agent.learn(options.steps)
    judged = Monitor(gymnasium.make(options.env, render_mode="human" if options.show else None))
    mean, deviation = evaluate_policy(agent, judged, options.episodes)
    print(f"score {mean:.0f} +- {deviation:.0f} over {options.episodes} episodes")


if __name__ == "__main__":
    main()
