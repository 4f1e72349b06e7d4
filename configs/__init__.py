"""Hydra configuration groups: env/ (Table 1), algo/, size/, and tuned/ where a size needs numbers of its own for a task."""
