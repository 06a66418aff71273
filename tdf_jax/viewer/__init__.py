"""`tdf view`: an imitation, a landscape or simulated episodes in a browser. It needs the extra "viewer".

Modules:
    demonstrating: a demonstration by hand
    energies: an energy landscape on the screen
    episodes: simulated episodes on the screen
    handles: what is drawn, and how it is moved
    local_server: the address, and its errors
    player: a slider over time, with a button that plays it
    solving: picks, paths and energies of what is dragged
    stage: an imitation on the screen, and what the mouse does
    worker: computes the latest request only
"""
