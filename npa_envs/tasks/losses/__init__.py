"""Losses that compare pictures: textures by several statistics, structure by MS-SSIM."""
