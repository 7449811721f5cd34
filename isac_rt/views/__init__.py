"""What people and other programs see of a run: figures, pictures, animations, the report, files of
other tools."""
