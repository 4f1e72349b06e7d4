"""PETS (Chua et al., 2018): no policy; every action is planned in the N models."""
