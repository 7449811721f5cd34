"""Views of a run for people and other programs: figures, pictures, animations, the report, files of
other tools."""
