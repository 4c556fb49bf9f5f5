"""From irradiance to grey values: speckle, detector, flaws of real images, and the peak finder of 3D cameras."""
