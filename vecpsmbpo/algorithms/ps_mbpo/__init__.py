"""PS-MBPO and OPS-MBPO (Algorithm 1), and what only differs from them in settings: MBPO and SAC."""
