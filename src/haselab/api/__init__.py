"""What `import haselab as hl` offers: short calls for notebooks and scripts."""
