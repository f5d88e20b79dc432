"""The GPU: its arrays, its kernels (kernels/*.cu), and how they are compiled and launched."""
