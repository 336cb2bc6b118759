"""Two images are compared: PSNR, SSIM, LPIPS."""
