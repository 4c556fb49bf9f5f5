"""Descriptions of scenes, objects, finishes and campaigns, and their conversion to Mitsuba scenes."""
