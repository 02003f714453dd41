"""Films of episodes: `camera` asks an env for frames, `video_file` hands them to ffmpeg.

It runs beside the env, in its process. Which envs are filmed is decided by the group.
"""
