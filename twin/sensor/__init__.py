"""From irradiance to grey values: speckle and detector."""
