"""Networks, one file each. Nothing below this floor loads one."""
