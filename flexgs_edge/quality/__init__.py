"""Compare two images by PSNR, SSIM and LPIPS, and collect the figures over views."""
