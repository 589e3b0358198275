// Decks on a Roomba 600: power bank and Raspberry Pi below, RPLidar A1 and mushroom switch above, and, if wanted, a roof.
//
// Printed flat, without supports, with 0.2 mm layers; no part is larger than 220 mm. Four threaded rods M3 hold the stack.
// Parts: openscad -D 'part="lower"' -o lower.stl decks.scad; likewise "upper", "foot", "post", and with a roof "roof",
// "roof_post". Lines for robot.toml and site.toml: openscad -D 'part="settings"' -o settings.echo decks.scad
// Axes in mm as in robot.toml: x ahead, y left of the point between the driven wheels; z up from the floor.

part = "assembly";

roof = false;             // a third deck above the lidar: its posts stand in the lidar's view, and are masked
power_bank = [148, 74, 16];   // length (its sockets are at the front end), width, height: measure yours
lidar_at = [0, 0];        // the lidar's axis. In the middle, the body's rim is beyond its shortest range (150 mm) everywhere
lidar_turn = 90;          // degrees: where the motor's end of the lidar points, from straight back to the right
switch_at = [-64, 0];     // the mushroom switch, behind the lidar, where a person who walks behind reaches it
has_switch = true;

roomba = [340, 92];       // diameter, height
clean_button = [30, 0, 30];   // its place and the free column above it: reached by a finger from ahead. Measure yours
dock_receiver = [150, 0, 24]; // the window on top of the bumper by which it finds its dock: nothing may cover it
serial_socket = [0, -135, 28];// the column for the plug in its serial socket, under the lid. Measure yours
foot = [24, 10];          // diameter, height
deck = 4;                 // thickness
wall = 2;
play = 0.5;               // around what is put in
rod = 3.4;                // bore for an M3 rod
post = 10;                // diameters of the posts
roof_post = 7;
post_x = 60;              // of all posts, ahead and behind
pad = 8;                  // radius of the decks around a post

pi = [85, 56, 1.4];       // Raspberry Pi 4 or 5: length, width, thickness
pi_at = [-48, -17];       // its corner behind, nearest to the middle; its USB sockets look ahead, its USB-C plug to the right
pi_holes = [58, 49, 3.5]; // along, across, from the edges
standoff = 6;
pi_tall = 16;             // from the board to the top of its USB sockets
plug = [45, 30];          // room for a plugged cable: ahead of the USB sockets, beside the USB-C socket
adapter = [52, 27, 12];   // the lidar's USB adapter, in the middle under the switch's cable
adapter_at = [-19, 0];

lidar = [98.5, 71, 60];   // RPLIDAR A1: length, width, height
lidar_axis = 36;          // from the axis to the end away from the motor
lidar_plane = 49;         // from the deck up to its beam
lidar_head = 76;          // diameter of what turns, with play
lidar_optics = 25;        // from the axis to the outer edge of its beam and of its lens: an estimate, measure yours
lidar_slots = [16, 33];   // its screws' distance from the middle of its base: published drawings differ, so slots
beam_play = 6;            // above and below the beam: its tilt, and the deck's
switch_head = [40, 32];   // mushroom: diameter, height above the deck
switch_body = [32, 42];   // below the deck: diameter, depth
switch_hole = 22.4;
mask_margin = 1;          // degrees on both sides
$fn = 48;

bank_inner = clean_button[2] / 2 + 2;    // the middle lane stays free for button, adapter and switch
post_y = bank_inner + power_bank[1] + 3 * play + 2 * wall + post / 2;
gap = max(power_bank[2] + 8, standoff + pi[2] + pi_tall + 3, has_switch ? switch_body[1] + 2 : 0);   // between decks
lower_z = roomba[1] + foot[1];
upper_z = lower_z + deck + gap;
beam_z = upper_z + deck + lidar_plane;
roof_gap = lidar[2] + 8;
roof_z = upper_z + deck + roof_gap;
top_z = roof ? roof_z + deck : max(upper_z + deck + lidar[2], has_switch ? upper_z + deck + switch_head[1] : 0);
corners = [for (x = [1, -1], y = [1, -1]) [x * post_x, y * post_y]];
mask_half = [for (c = corners) asin((roof_post / 2 + lidar_optics) / norm(c - lidar_at)) + mask_margin];

module at_posts() { for (c = corners) translate(c) children(); }

module outline(more = []) {
    hull() { at_posts() circle(pad); for (m = more) translate([m[0], m[1]]) circle(m[2]); }
}

module slab(more = []) {
    difference() {
        linear_extrude(deck) outline(more);
        at_posts() translate([0, 0, -1]) cylinder(d = rod, h = deck + 2);
    }
}

module tube(d, h) { difference() { cylinder(d = d, h = h); translate([0, 0, -1]) cylinder(d = rod, h = h + 2); } }

// Recess for the rod's nut at the underside; what sticks the foot to the robot (Dual Lock) covers it.
module foot() {
    difference() {
        tube(foot[0], foot[1]);
        translate([0, 0, -0.01]) cylinder(d = 6.6, h = 3, $fn = 6);
    }
}

bank_y = [bank_inner + wall, bank_inner + wall + power_bank[1] + 2 * play];   // the tray's inner sides
module tray() {
    height = min(12, power_bank[2]);
    length = power_bank[0] + 2 * play;
    difference() {
        translate([-length / 2 - wall, bank_y[0] - wall, 0]) cube([length + 2 * wall, bank_y[1] - bank_y[0] + 2 * wall, height]);
        translate([-length / 2, bank_y[0], -1]) cube([length, bank_y[1] - bank_y[0], height + 2]);
        // The end walls hold by their corners only: in front the bank's sockets, behind its button.
        translate([-length, bank_y[0] + 8, -1]) cube([2 * length, bank_y[1] - bank_y[0] - 16, height + 2]);
    }
}

module lower() {
    half = power_bank[0] / 2 + play + wall;
    difference() {
        union() {
            slab([for (x = [1, -1]) [x * (half - 4), bank_y[1] + wall - 4, 4], for (x = [1, -1]) [x * (half - 4), -post_y + 12, 4]]);
            translate([0, 0, deck - 0.01]) tray();
            at_pi_holes() translate([0, 0, deck - 0.01]) cylinder(d = 6, h = standoff + 0.01);
        }
        at_pi_holes() translate([0, 0, -1]) cylinder(d = 2.2, h = deck + standoff + 2);   // M2.5, self-tapping
        translate([clean_button[0], clean_button[1], -1]) cylinder(d = clean_button[2], h = deck + 2);
        // Slots for a strap (20 mm) around the bank, and for ties around cables.
        for (x = [-45, 45], y = [bank_y[0] + 3, bank_y[1] - 6]) translate([x - 11, y, -1]) cube([22, 3, deck + 2]);
        for (x = [-68, 62], y = [-36, -70]) translate([x - 2, y, -1]) cube([3, 8, deck + 2]);
    }
}

module at_pi_holes() {
    for (x = [0, pi_holes[0]], y = [0, pi_holes[1]])
        translate([pi_at[0] + pi_holes[2] + x, pi_at[1] - pi_holes[2] - y, 0]) children();
}

// The lidar's own frame: its axis at the origin, its motor's end towards -x.
module at_lidar() { translate([lidar_at[0], lidar_at[1], upper_z + deck]) rotate([0, 0, lidar_turn]) children(); }
lidar_middle = lidar_axis - lidar[0] / 2;    // of its base, along its length

module upper() {
    difference() {
        slab(has_switch ? [[switch_at[0], switch_at[1], switch_head[0] / 2 + 4]] : []);
        if (has_switch) translate([switch_at[0], switch_at[1], -1]) cylinder(d = switch_hole, h = deck + 2);
        translate([0, 0, -upper_z - deck]) at_lidar() translate([lidar_middle, 0, -1]) {
            for (a = [45:90:315]) rotate([0, 0, a]) hull() for (r = lidar_slots) translate([r, 0, -deck]) cylinder(d = rod, h = deck + 2);
            // Its cable goes down here.
            translate([-lidar[0] / 2 - 9, -8, -deck]) cube([7, 16, deck + 2]);
        }
        for (x = [44, -44], y = [1, -1]) translate([x, y * 0.62 * post_y, -1]) cylinder(d = 22, h = deck + 2);   // air for the Pi
    }
}

module roof() { slab(); }

// What is not printed. -------------------------------------------------------------------------------------------------

module bank(grow = 0) {
    translate([-power_bank[0] / 2 - grow, bank_y[0] + play - grow, lower_z + deck - grow]) cube(power_bank + 2 * grow * [1, 1, 1]);
}
module bank_plugs() {
    translate([power_bank[0] / 2 + 0.1, bank_y[0] + 12, lower_z + deck + 2]) cube([plug[1], power_bank[1] - 24, power_bank[2] - 4]);
}
module board() { translate([pi_at[0], pi_at[1] - pi[1], lower_z + deck + standoff + 0.05]) cube(pi); }
module sockets() {
    translate([pi_at[0] + pi[0] - 18, pi_at[1] - pi[1] + 2, lower_z + deck + standoff + pi[2] + 0.1]) cube([20.5, pi[1] - 4, pi_tall]);
}
module pi_plugs() {
    z = lower_z + deck + standoff + pi[2];
    translate([pi_at[0] + pi[0] + 2.6, pi_at[1] - pi[1] + 2, z + 1]) cube([plug[0], 36, pi_tall - 2]);
    translate([pi_at[0] + 11.2 - 6, pi_at[1] - pi[1] - plug[1], z - 2]) cube([12, plug[1] - 0.1, 8]);
}
module usb_adapter() { translate([adapter_at[0] - adapter[0] / 2, adapter_at[1] - adapter[1] / 2, lower_z + deck + 0.05]) cube(adapter); }
module lidar_base() {
    at_lidar() translate([lidar_middle - lidar[0] / 2, -lidar[1] / 2, 0.05]) cube([lidar[0], lidar[1], lidar_plane - 16]);
}
module lidar_head() { at_lidar() translate([0, 0, lidar_plane - 15.9]) cylinder(d = lidar_head, h = lidar[2] - lidar_plane + 15.9); }
module mushroom() {
    if (has_switch) translate([switch_at[0], switch_at[1], upper_z + deck]) {
        translate([0, 0, 0.05]) cylinder(d = 30, h = switch_head[1] - 12);
        translate([0, 0, switch_head[1] - 12]) cylinder(d = switch_head[0], h = 12);
    }
}
module mushroom_body() {
    if (has_switch) translate([switch_at[0], switch_at[1], upper_z - switch_body[1]]) cylinder(d = switch_body[0], h = switch_body[1] - 0.05);
}
module rods() { at_posts() translate([0, 0, roomba[1] + 0.5]) cylinder(d = 3, h = (roof ? roof_z : upper_z) + deck + 4 - roomba[1] - 0.5); }
module base() { cylinder(d = roomba[0], h = roomba[1] - 0.05); }
// From the robot up to where a finger, the plug or the dock's light comes from.
module free_columns() {
    translate([clean_button[0], clean_button[1], roomba[1]]) cylinder(d = clean_button[2] - 0.1, h = foot[1] + deck + gap - 0.1);
    translate([0, -clean_button[2] / 2 + 0.1, lower_z + deck + 0.1]) translate([clean_button[0], 0]) cube([roomba[0], clean_button[2] - 0.2, gap - 0.2]);
    for (column = [dock_receiver, serial_socket]) translate([column[0], column[1], roomba[1]]) cylinder(d = column[2], h = top_z);
}

module feet() { at_posts() translate([0, 0, roomba[1]]) foot(); }
module posts(h = gap) { at_posts() translate([0, 0, lower_z + deck]) tube(post, h); }
module roof_posts(h = roof_gap) { if (roof) at_posts() translate([0, 0, upper_z + deck]) tube(roof_post, h); }
module decks() {
    translate([0, 0, lower_z]) lower();
    translate([0, 0, upper_z]) upper();
    if (roof) translate([0, 0, roof_z]) roof();
}
module printed() { feet(); posts(); roof_posts(); decks(); }
module bought() {
    bank(-0.05); board(); sockets(); usb_adapter(); lidar_base(); lidar_head(); mushroom(); mushroom_body();
}

// The slab in which the beam turns, out to where the body ends.
module view() {
    translate([lidar_at[0], lidar_at[1], beam_z - beam_play]) difference() {
        cylinder(d = roomba[0] + 2 * norm(lidar_at), h = 2 * beam_play);
        translate([0, 0, -1]) cylinder(d = lidar_head + 0.1, h = 2 * beam_play + 2);
    }
}
module masked() {
    if (roof) for (n = [0:3]) translate([lidar_at[0], lidar_at[1], 0]) linear_extrude(2 * top_z)
        polygon([[0, 0], for (side = [-1, 1]) let(a = bearing(n) + side * mask_half[n]) 400 * [cos(a), sin(a)]]);
}
function bearing(n) = atan2(corners[n][1] - lidar_at[1], corners[n][0] - lidar_at[0]);
function rad(a) = round(a * PI / 180 * 1000) / 1000;
masks = [for (n = [0, 2, 3, 1]) [rad(bearing(n) - mask_half[n]), rad(bearing(n) + mask_half[n])]];

if (part == "settings") {
    echo(str("x_m = ", lidar_at[0] / 1000));
    echo(str("y_m = ", lidar_at[1] / 1000));
    echo(str("masks = ", roof ? masks : []));
    echo(str("height = ", ceil(top_z / 5) * 5 / 1000));
    echo(str("beam = ", round(beam_z) / 1000));
    echo(str("rods = ", ceil((roof ? roof_z : upper_z) + deck + 5 - roomba[1])));
}
else if (part == "lower") lower();
else if (part == "upper") upper();
else if (part == "roof") roof();
else if (part == "foot") foot();
else if (part == "post") tube(post, gap);
else if (part == "roof_post") tube(roof_post, roof_gap);
else if (part == "shown_base") base();
else if (part == "shown_bumper") intersection() { difference() { translate([0, 0, 12]) cylinder(d = roomba[0] + 1, h = 62); translate([0, 0, 11]) cylinder(d = roomba[0] - 20, h = 64); } translate([4, -200, 0]) cube([200, 400, 200]); }
else if (part == "shown_button") translate([clean_button[0], clean_button[1], roomba[1] - 0.5]) cylinder(d = clean_button[2] - 4, h = 2);
else if (part == "shown_receiver") translate([dock_receiver[0], dock_receiver[1], roomba[1] - 0.5]) cylinder(d = dock_receiver[2], h = 5);
else if (part == "shown_feet") feet();
else if (part == "shown_lower") translate([0, 0, lower_z]) lower();
else if (part == "shown_bank") bank();
else if (part == "shown_board") board();
else if (part == "shown_sockets") sockets();
else if (part == "shown_adapter") usb_adapter();
else if (part == "shown_posts") posts();
else if (part == "shown_rods") rods();
else if (part == "shown_upper") translate([0, 0, upper_z]) upper();
else if (part == "shown_lidar_base") lidar_base();
else if (part == "shown_lidar_head") lidar_head();
else if (part == "shown_mushroom") mushroom();
else if (part == "shown_mushroom_body") mushroom_body();
else if (part == "shown_roof_posts") roof_posts();
else if (part == "shown_roof") { if (roof) translate([0, 0, roof_z]) roof(); }
// What is in each other's way: nothing may be. One printed part ends where the next begins.
else if (part == "collisions") {
    intersection() { printed(); bought(); }
    intersection() {
        decks();
        union() { translate([0, 0, 0.05]) { posts(gap - 0.1); roof_posts(roof_gap - 0.1); } translate([0, 0, -0.1]) feet(); }
    }
    intersection() { union() { printed(); bought(); } union() { base(); free_columns(); } }
    intersection() { union() { bank_plugs(); pi_plugs(); } union() { printed(); bought(); free_columns(); } }
    intersection() { union() { bank(); bank_plugs(); } union() { board(); sockets(); usb_adapter(); pi_plugs(); mushroom_body(); } }
    intersection() { union() { board(); sockets(); pi_plugs(); } union() { usb_adapter(); mushroom_body(); } }
    intersection() { usb_adapter(); mushroom_body(); }
    intersection() { union() { lidar_base(); lidar_head(); } union() { mushroom(); rods(); } }
    intersection() { rods(); bought(); }
    // Nothing is wider than the robot, or it would touch what the robot takes for free.
    difference() { union() { printed(); bought(); bank_plugs(); pi_plugs(); } translate([0, 0, -1]) cylinder(d = roomba[0], h = 2 * top_z); }
}
// What the lidar sees of the robot beside its masks: nothing.
else if (part == "seen") intersection() { difference() { view(); masked(); } union() { printed(); mushroom(); rods(); } }
else { base(); printed(); bought(); rods(); }
