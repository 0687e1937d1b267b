"""One page that shows a scene in 3D: packed Gaussians, a renderer for browsers, and the writer of the page's file."""
