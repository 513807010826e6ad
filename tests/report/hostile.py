"""A text that is no harm, if it stays one."""

HOSTILE = "</script><script>document.title='taken'</script>\"'><img src=x onerror=document.title='taken'>&amp;{{7*7}}"
"""What nobody would call a file, unless to see what a page makes of it."""
