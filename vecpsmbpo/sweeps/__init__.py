"""The runs of a grid as jobs: of Slurm, of Ray, or processes of this machine."""
