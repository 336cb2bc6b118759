"""Compare two images by PSNR, SSIM, FLIP and LPIPS, and collect the figures over views."""
