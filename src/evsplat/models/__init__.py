"""Models: person and scene, posed at any time and drawn, one folder each."""
