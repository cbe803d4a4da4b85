"""The experiment file and the images it names, read and checked before any work."""
