"""Coverage-guided fuzzing (atheris, extra fuzz) of what is parsed here and not by a library: see targets.py."""
