"""What a calibration still lacks, whether an image is good enough for it, and what to do next; without hardware."""
