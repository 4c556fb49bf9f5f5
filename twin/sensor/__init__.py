"""From irradiance to grey values: speckle, detector, and flaws of real images."""
