"""`rollout` and `eval`: play episodes, film them, and show what came of them."""
