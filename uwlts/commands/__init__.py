"""The commands of ``uwlts``, by what they are about; those of a module import what they need when they run."""
