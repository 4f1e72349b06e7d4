"""What can befall a run: a file for each kind of harm, whose functions are the parts of tools/faults."""
