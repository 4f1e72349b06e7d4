"""SLBO (Luo et al., 2019): one model and one policy, which learn in turns."""
