"""Films of episodes: `camera` asks an env for frames, `video_file` hands them to ffmpeg.

It runs beside the env, in its process. Which envs are filmed is decided by the group: when an env
is built (`video` of an entry), or by a call that the runner answers in place of the env. ffmpeg is
a process of its own, which completes a file even if the env's worker dies.
"""
