"""Descriptions of scenes, objects, finishes and campaigns, and the Mitsuba scene that they become."""
