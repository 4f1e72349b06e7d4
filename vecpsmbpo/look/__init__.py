"""What a person sees of runs: curves, tables, a page, videos. Reads run directories; writes what it is told to.

The modules that read and draw do not import JAX; those that need a checkpoint (`diagnostics`, `render`, `export`) do.
"""
