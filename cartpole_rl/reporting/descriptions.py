"""Descriptions of all curves, histograms and pictures, shown by TensorBoard beside their names."""

OF_EPISODES = {
    "score": "Score (6.2) of an episode: the sum over its periods.",
    "score_upright": "Score (6.1) of an episode: the sum over its periods; only an upright pole scores.",
    "steps": "Control periods of an episode. Fewer than the time limit: it ended early.",
    "upright_fraction": "Share of an episode in which the pole is within 5 degrees of upright.",
    "track_guard_fraction": "Share of the periods in which the track guard replaced the agent's motor value.",
    "guarded_fraction": "Share of the periods in which the track guard replaced the agent's motor value.",
    "time_to_upright_s": "Seconds until the pole stays upright for one second.",
}
GROUPS = {
    "evaluation": "Mean over the episodes of an evaluation, without exploration, on nominal carts.",
    "exploration": "Mean over the training episodes that ended since the last point, with random actions.",
    "summary": "Mean over the episodes of the last evaluation.",
}
DESCRIPTIONS = {
    "evaluation/score": "Mean score (6.2) of the greedy policy on nominal carts: judge a training by it.",
    "evaluation/score_min": "Score (6.2) of the worst episode of an evaluation.",
    "evaluation/score_max": "Score (6.2) of the best episode of an evaluation.",
    "evaluation/seconds": "Seconds of training until this evaluation.",
    "exploration/episode_length": "Mean control periods of the episodes that ended since the last point.",
    "learning/loss": "Mean loss of the updates of an iteration.",
    "learning/gradient_norm": "Mean norm of the loss's gradient, before it is clipped.",
    "learning/learning_rate": "Learning rate of the optimizer.",
    "learning/q_mean": "Mean predicted return of the chosen actions: it should settle, not grow without end.",
    "learning/q_max": "Largest predicted return of the chosen actions.",
    "learning/epsilon": "Share of random actions in training.",
    "learning/updates": "Gradient steps so far.",
    "speed/transitions_per_second": "Transitions a second, collecting, learning and evaluating included.",
    "pictures/behaviour": "Position, angle and motor value of the first episode of an evaluation.",
    "pictures/cart": "Animation of the first episode of an evaluation, in real time.",
    "cart/score_before": "Score (6.2) of each episode on the cart before fine-tuning, without exploration.",
    "cart/score_tune": "Score (6.2) of each episode that fine-tuning learns from, with random actions.",
    "cart/score_after": "Score (6.2) of each episode on the cart after fine-tuning, without exploration.",
    "cart/score_in_simulation": "Score (6.2) of the agent on simulated carts like this one.",
    "link/frames_received": "Frames from the cart so far.",
    "link/bad_frames": "Damaged frames so far.",
    "link/lost_frames": "States that never arrived, so far.",
    "link/overtaken_frames": "States that arrived after a newer one, so far.",
    "link/repeated_frames": "States that arrived twice, so far.",
    "link/late_ticks": "States that were answered too late or not at all, so far; 0 is good.",
    "link/latency_samples": "Answers whose latency was measured.",
    "link/latency_median_ms": "Median time from a state's arrival to the end of its command, ms.",
    "link/latency_p99_ms": "99th percentile of that time, ms.",
    "link/latency_p999_ms": "99.9th percentile of that time, ms.",
    "link/latency_max_ms": "Longest such time, ms.",
}
PREFIXES = {
    "randomization/": "Distribution of this parameter over the simulated carts, in SI units.",
    "cart/guarded_": "Share of the periods of an episode in which the track guard replaced the motor value.",
}


def description(tag: str) -> str:
    """Return the description of a curve, a histogram or a picture; empty for an unknown one."""
    if tag in DESCRIPTIONS:
        return DESCRIPTIONS[tag]
    group, _, name = tag.partition("/")
    if group in GROUPS and name in OF_EPISODES:
        return f"{OF_EPISODES[name]} {GROUPS[group]}"
    return next((text for prefix, text in PREFIXES.items() if tag.startswith(prefix)), "")
