"""The original simulators behind one batched interface: the fallback for tasks that MJX cannot run."""
