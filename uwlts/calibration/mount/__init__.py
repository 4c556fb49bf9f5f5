"""Mount of a sensor on a moving platform, or axis of a rotary table: one estimate from profiles or target images."""
