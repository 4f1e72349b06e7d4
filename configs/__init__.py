"""Hydra configuration groups: env/ (Table 1), algo/, size/; tuned/ where a task has numbers of its own at a size."""
