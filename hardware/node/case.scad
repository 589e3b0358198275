// Case of a wall-mounted sensor node: two HC-SR04 behind slanted faces, a Wemos D1 mini on the wall plate.
//
// Printed without supports: the body on its upper side, the plate on its wall side, both with 0.2 mm layers.
// Parts to print: openscad -D 'part="body"' -o body.stl case.scad; likewise "plate".
// Axes in mm: x along the wall, y away from the wall, z up. The wall is at y = 0.

part = "assembly";       // "assembly", "body", "plate"

sonar_angle = 12.6;      // degrees by which each sonar looks to its side: `angle` = 0.22 rad in site.toml
power_bank = [0, 0, 0];  // width, depth and height of a power bank below the electronics; zeros: power by cable
wall = 2;                // thickness of all walls
gap = 0.4;               // play between printed parts

sonar_board = [45.5, 20.5, 1.6];  // an HC-SR04: width, height, thickness. Clones differ by a millimetre: measure yours
sonar_can = [16.4, 12.3];         // a transducer: diameter with play, height above the board
sonar_cans_apart = 26;            // between the middles of the two transducers
sonar_holes = [42.0, 17.0];       // between the mounting holes
can_proud = 2;                    // by which the transducers stand out of the face
mcu_board = [34.4, 25.8, 1.2];    // a D1 mini: length, width, thickness
mcu_slot = 6;                     // from the plate to the board: its soldered wires need it
mcu_play = 0.2;                   // of the board in its rails
rail = 3;                         // thickness of a rail
rail_grip = 0.6;                  // by which it reaches over the board's edge: behind it the soldered pins begin
cable = [11, 8];                  // the hole for the micro-USB plug's overmould: width, depth

mcu_back = wall + mcu_slot + mcu_play;       // the D1 mini's side that looks to the wall
plug_middle = mcu_back + mcu_board[2] + 1.4;
bank_back = plug_middle + cable[1] / 2 + 1;  // a power bank lies in front of the plug
face = sonar_board[0] + 2 * wall + 2;        // width of a slanted face
// Inside: the sonars lie, the D1 mini stands on its plug.
electronics_height = max(sonar_board[1], mcu_board[0]) + 4;
has_bank = power_bank[0] > 0;
bay_height = has_bank ? power_bank[2] + 1 : 0;
height = electronics_height + 2 * wall + (has_bank ? bay_height + wall : 0);
half_width = max(face * cos(sonar_angle), has_bank ? power_bank[0] / 2 + wall + 1 : 0);
side_depth = max(34, has_bank ? bank_back + power_bank[1] + wall + 1 : 0);   // at both ends; the middle stands out further
depth = side_depth + face * sin(sonar_angle);
floor_of_electronics = wall + (has_bank ? bay_height + wall : 0);
sonar_height = floor_of_electronics + electronics_height / 2;
mcu_low = floor_of_electronics + 1;
$fn = 48;

module outline() {
    polygon([
        [-half_width, 0], [half_width, 0],
        [half_width, depth - half_width * tan(sonar_angle)], [0, depth],
        [-half_width, depth - half_width * tan(sonar_angle)],
    ]);
}

// Puts children on the outer side of the face of one sonar: x along the face, y out of it, the origin in its middle.
module at_face(side) {
    translate([0, depth, sonar_height]) rotate([0, 0, -side * sonar_angle]) translate([side * face / 2, 0, 0]) children();
}

module can_holes(side) {
    at_face(side) for (x = [-1, 1])
        translate([x * sonar_cans_apart / 2, 1, 0]) rotate([90, 0, 0]) cylinder(d = sonar_can[0], h = wall * 2 + 2);
}

// Four posts behind the face; the board is screwed onto them (M1.6 x 6, self-tapping) or held by a drop of hot glue.
module posts(side) {
    behind = sonar_can[1] - can_proud;       // from the outer side of the face to the board
    at_face(side) for (x = [-1, 1], z = [-1, 1]) translate([x * sonar_holes[0] / 2, 0, z * sonar_holes[1] / 2])
        rotate([90, 0, 0]) difference() {
            translate([0, 0, wall / 2]) cylinder(d = 4, h = behind - wall / 2);
            translate([0, 0, wall]) cylinder(d = 1.4, h = behind);
        }
}

module vents(side) {
    for (n = [0:3]) translate([side * half_width, 9 + 5 * n, sonar_height])
        cube([4 * wall, 2, electronics_height * 0.6], center = true);
}

// The screws that hold the plate (M3 x 8, countersunk: the plate lies flat on the wall), in blocks in the body's corners.
module screw_places() {
    for (side = [-1, 1]) translate([side * (half_width - wall - 3.5), 0, sonar_height]) children();
}

module body() {
    difference() {
        linear_extrude(height) outline();
        difference() {
            translate([0, 0, wall]) linear_extrude(height - 2 * wall) intersection() {
                offset(delta = -wall) outline();
                translate([-500, 0]) square([1000, 1000]);
            }
            if (has_bank) translate([-500, -1, wall + bay_height]) cube([1000, 1000, wall]);
        }
        // Open towards the wall: the plate closes it.
        translate([-half_width + wall, -1, wall]) cube([2 * (half_width - wall), 1 + wall + gap, height - 2 * wall]);
        for (side = [-1, 1]) { can_holes(side); vents(side); }
        // The plug of the supply comes from below, or through the floor of the electronics from the power bank.
        translate([-cable[0] / 2, plug_middle - cable[1] / 2, -1]) cube([cable[0], cable[1], has_bank ? 0 : wall + 2]);
        if (has_bank) translate([-cable[0] / 2, plug_middle - cable[1] / 2, wall + bay_height - 1]) cube([cable[0], cable[1], wall + 2]);
    }
    for (side = [-1, 1]) posts(side);
    screw_places() difference() {
        translate([-3.5, wall + gap, -5]) cube([7, 8, 10]);
        rotate([-90, 0, 0]) cylinder(d = 2.5, h = 20);
    }
}

// A slot into which the head of a wall screw (4 mm, head up to 8 mm) is pushed upwards.
module keyhole() {
    rotate([-90, 0, 0]) { cylinder(d = 9, h = 3 * wall, center = true); }
    translate([0, 0, 5]) cube([4.6, 3 * wall, 10], center = true);
}

module plate() {
    width = 2 * (half_width - wall - gap);
    difference() {
        union() {
            translate([-width / 2, 0, wall + gap]) cube([width, wall, height - 2 * (wall + gap)]);
            // Two rails hold the D1 mini upright at the plate, its plug downwards.
            for (side = [-1, 1]) translate([0, wall, floor_of_electronics + 1]) difference() {
                translate([side * (mcu_board[1] / 2 - rail_grip + rail / 2) - rail / 2, 0, 0])
                    cube([rail, mcu_slot + 3, electronics_height - 3]);
                translate([-mcu_board[1] / 2 - mcu_play, mcu_slot, -1])
                    cube([mcu_board[1] + 2 * mcu_play, mcu_board[2] + 2 * mcu_play, electronics_height]);
            }
        }
        for (side = [-1, 1]) translate([side * half_width * 0.6, 0, sonar_height]) keyhole();
        screw_places() rotate([-90, 0, 0]) {
            cylinder(d = 3.4, h = 20, center = true);
            translate([0, 0, -0.01]) cylinder(d1 = 6.4, d2 = 3.4, h = 1.5);
        }
    }
}

// What is not printed, for the picture and to see that it fits. ------------------------------------------------------

module sonar_boards(size = sonar_board) {
    for (side = [-1, 1]) at_face(side) translate([0, -sonar_can[1] + can_proud - sonar_board[2] / 2, 0])
        cube([size[0], size[2], size[1]], center = true);
}

module cans(d, from, to) {
    for (side = [-1, 1]) at_face(side) for (x = [-1, 1])
        translate([x * sonar_cans_apart / 2, can_proud - from, 0]) rotate([90, 0, 0]) cylinder(d = d, h = to - from);
}

module mcu(size = mcu_board) {
    translate([-size[1] / 2, mcu_back, mcu_low]) cube([size[1], size[2], size[0]]);
}

module on_mcu(x, z, size) {
    translate([x - size[0] / 2, mcu_back + mcu_board[2], mcu_low + z]) cube([size[0], size[1], size[2]]);
}

module usb_socket() { on_mcu(0, 0, [7.6, 2.7, 5.6]); }

module cable() {
    translate([-cable[0] / 2 + 0.4, plug_middle - cable[1] / 2 + 0.4, mcu_low - 20])
        cube([cable[0] - 0.8, cable[1] - 0.8, 19]);
    // Inside the bay it bends to the power bank.
    if (!has_bank) translate([0, plug_middle, mcu_low - 45]) cylinder(d = 4, h = 26);
}

module bank() {
    if (has_bank) translate([-power_bank[0] / 2, bank_back, wall + 0.5]) cube(power_bank);
}

module screws() {
    screw_places() rotate([-90, 0, 0]) { cylinder(d1 = 5.6, d2 = 3, h = 1.5); cylinder(d = 3, h = 8); }
}

if (part == "body") rotate([180, 0, 0]) body();
else if (part == "plate") rotate([90, 0, 0]) plate();
// As they hang on the wall:
else if (part == "shown_body") body();
else if (part == "shown_plate") plate();
else if (part == "shown_sonar_boards") sonar_boards();
else if (part == "shown_cans") cans(16, 0, sonar_can[1]);
else if (part == "shown_meshes") cans(12.4, -0.1, 0);
else if (part == "shown_mcu") mcu();
else if (part == "shown_mcu_shield") on_mcu(0, 13, [12.2, 3, 15]);
else if (part == "shown_mcu_antenna") on_mcu(0, 28, [15, 0.8, 6.2]);
else if (part == "shown_usb") usb_socket();
else if (part == "shown_cable") cable();
else if (part == "shown_screws") screws();
// What is in each other's way: nothing may be.
else if (part == "collisions") {
    intersection() { body(); plate(); }
    intersection() {
        union() { body(); plate(); }
        // The boards lie on their posts and in their slots: a hair smaller, they touch nothing.
        union() { mcu(mcu_board - [0.1, 0.1, 0.1]); usb_socket(); sonar_boards(sonar_board - [0.1, 0.1, 0.1]); cans(16, 0, sonar_can[1]); cable(); bank(); }
    }
    intersection() { bank(); cable(); }
    intersection() {
        union() { mcu(); on_mcu(0, 0, [mcu_board[1], 6, mcu_board[0]]); }
        union() { sonar_boards(); cans(16, 0, sonar_can[1]); }
    }
}
else { body(); plate(); sonar_boards(); cans(16, 0, sonar_can[1]); mcu(); usb_socket(); cable(); }
