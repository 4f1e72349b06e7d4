"""MJX ports, one file per task, each a `brax.envs.base.Env`."""
