"""The detector of square markers, in three phases: candidates, filtering, refinement."""
