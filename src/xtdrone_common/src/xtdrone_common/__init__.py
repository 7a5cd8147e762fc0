"""What every package may use: settings, programs, fleet, frames, poses, cameras, geodesy, files, kernels."""
