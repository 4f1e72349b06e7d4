"""The paper's theory (section 2, section 3.1, appendix G), runnable: `vecpsmbpo theory`. Needs numpy and scipy only."""
