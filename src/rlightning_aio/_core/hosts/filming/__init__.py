"""Films of episodes: `camera` asks an env for frames, `video_file` hands them to ffmpeg.

It runs beside the env, in its process. The group decides which envs are filmed, by a call that the
runner answers in place of the env; the order to attach a replacement repeats it. ffmpeg is a
process of its own, which completes a file even if the env's worker dies.
"""
